"""The estimator against truth that it does not see: consistency, delays, resets, dead reckoning."""

import math

import numpy as np
import pytest

from sim.autopilot.estimator import Estimator
from sim.autopilot.params import Parameters
from sim.autopilot.readings import ExternalPose, GpsFix

DT = 0.0025
STEP_NS = 2_500_000
G = 9.80665


class Figure:
    """Known motion in NED, heading along a circle: closed-form pose, rates and specific force."""

    def __init__(self, radius=3.0, rate=0.6):
        self.radius, self.rate = radius, rate

    def at(self, t):
        """p_ned, v_ned, a_ned, yaw at t; at rest for the first second, then ever faster, then steady."""
        phase, speed, accel = self._phase(t)
        s, c = math.sin(phase), math.cos(phase)
        p = np.array([self.radius * s, self.radius * (1 - c), -2.0 * (1 - c)])
        dp = np.array([self.radius * c, self.radius * s, -2.0 * s])
        ddp = np.array([-self.radius * s, self.radius * c, -2.0 * c])
        return p, dp * speed, dp * accel + ddp * speed**2, phase

    def _phase(self, t):
        t = max(t - 1.0, 0.0)
        ramp = 3.0
        if t < ramp:
            return 0.5 * self.rate / ramp * t * t, self.rate * t / ramp, self.rate / ramp if t > 0 else 0.0
        return self.rate * (t - 0.5 * ramp), self.rate, 0.0

    def imu(self, t):
        """Body FLU rate and specific force, level attitude: mean over the step by its middle."""
        _, _, a, yaw = self.at(t - DT / 2)
        _, speed, _ = self._phase(t - DT / 2)
        f = a - np.array([0.0, 0.0, G])
        c, s = math.cos(yaw), math.sin(yaw)
        frd = np.array([c * f[0] + s * f[1], -s * f[0] + c * f[1], f[2]])
        return np.array([0.0, 0.0, -speed]), frd * (1, -1, -1)


def run(seconds, *, seed=0, parameters=None, delay_ns=0, stamped=True, biases=True, hook=None, hz=30):
    """Errors of p, v, yaw (K, 7) and normalised squared errors of p, v, yaw (K,) once per 0.1 s."""
    rng = np.random.default_rng(seed)
    estimator, motion = Estimator(parameters or Parameters(), boot_heading=None), Figure()
    gyro_bias, accel_bias = (rng.normal(0, 0.01, 3), rng.normal(0, 0.1, 3)) if biases else (0, 0)
    errors, nees, every = [], [], round(400 / hz)
    for k in range(1, round(seconds / DT) + 1):
        t, now = k * DT, k * STEP_NS
        gyro, accel = motion.imu(t)
        gyro = gyro + gyro_bias + rng.normal(0, 0.003, 3)
        estimator.imu(now, gyro, accel + accel_bias + rng.normal(0, 0.05, 3), DT)
        if k % 4 == 0:
            estimator.hold(at_rest=t < 1.0)
        if k % every == 0:
            p, v, _, yaw = motion.at(t - delay_ns * 1e-9)
            noise = rng.normal(0, 0.1, 7)
            pose = ExternalPose(
                stamp_ns=now - (delay_ns if stamped else 0), p=p + noise[:3], v=v + noise[3:6], v_in_body=False,
                yaw=yaw + noise[6], variance=np.full(7, 1e-4), aligned_with_north=False, reset_counter=0, quality=100,
            )  # fmt: skip
            estimator.external_pose(hook(pose, t) if hook else pose)
        if t > 6.0 and k % 40 == 0:
            p, v, _, yaw = motion.at(t)
            x = estimator.x
            own = math.atan2(2 * (x[0] * x[3] + x[1] * x[2]), 1 - 2 * (x[2] ** 2 + x[3] ** 2))
            e = np.array([*(estimator.p - p), *(estimator.v - v), math.remainder(own - yaw, 2 * math.pi)])
            errors.append(e)
            index = [6, 7, 8, 3, 4, 5, 2]
            nees.append(e @ np.linalg.solve(estimator.P[np.ix_(index, index)], e))
    return np.array(errors), np.array(nees), estimator


def test_errors_stay_within_what_the_filter_claims():
    nees = np.concatenate([run(14.0, seed=s)[1] for s in range(3)])
    # 7 degrees of freedom; PX4's noise figures are cautious, so it may be better than claimed.
    assert 1.0 < nees.mean() < 8.0
    assert (nees < 24.3).mean() > 0.98  # 99.9 % of chi-square(7)


def test_the_filter_beats_its_measurement():
    errors, _, estimator = run(20.0)
    rms = np.sqrt((errors**2).mean(axis=0))
    assert (rms[:3] < 0.06).all()  # measured with sigma 0.1
    assert (rms[3:6] < 0.06).all()
    assert rms[6] < 0.03
    assert estimator.resets == 3  # place, height and heading, once each, at the start


def test_a_stamped_delay_costs_nothing_an_unstamped_one_shows():
    stamped = np.abs(run(12.0, delay_ns=100_000_000)[0]).mean(axis=0)
    late = np.abs(run(12.0, delay_ns=100_000_000, stamped=False)[0]).mean(axis=0)
    assert (stamped[:3] < 0.06).all()
    assert late[:2].max() > 0.12  # 1.8 m/s for 0.1 s


def test_ev_delay_makes_up_for_a_missing_stamp():
    errors, _, _ = run(12.0, delay_ns=100_000_000, stamped=False, parameters=Parameters({"EKF2_EV_DELAY": 100.0}))
    assert (np.abs(errors[:, :3]).mean(axis=0) < 0.06).all()


def jumped(by, *, counted):
    def hook(pose, t):
        if t < 9.0:
            return pose
        return pose._replace(p=pose.p + by, reset_counter=1 if counted else 0)

    return hook


def test_a_new_reset_counter_takes_the_jump_at_once():
    errors, _, estimator = run(11.0, hook=jumped(np.array([2.0, -1.0, 0.5]), counted=True))
    np.testing.assert_allclose(errors[35:, :3].mean(axis=0), [2.0, -1.0, 0.5], atol=0.05)
    assert np.abs(errors[35:, 3:6].mean(axis=0)).max() < 0.05  # the speed does not jump
    assert estimator.resets == 6


def test_an_uncounted_jump_is_rejected_until_the_time_out():
    errors, _, _ = run(16.0, hook=jumped(np.array([4.0, 0.0, 0.0]), counted=False))
    before, after = errors[(errors.shape[0] * 6) // 10, 0], errors[-1, 0]  # at 12 s, at 16 s
    assert abs(before) < 1.0
    assert after == pytest.approx(4.0, abs=0.2)


def test_validity_ends_4_8_s_after_the_last_odometry():
    def silence(pose, t):
        return pose._replace(quality=-1) if t > 8.0 else pose

    for seconds, valid in ((12.7, True), (12.9, False)):
        estimator = run(seconds, hook=silence)[2]
        assert estimator.xy_valid is valid
        assert bool(estimator.flags & 16) is valid
        assert bool(estimator.flags & 128) is not valid


@pytest.mark.parametrize(("control", "fused"), [(15, 7), (1, 2), (2, 1), (4, 3), (11, 4)])
def test_ev_ctrl_chooses_the_rows(control, fused):
    estimator = Estimator(Parameters({"EKF2_EV_CTRL": control}), boot_heading=0.0)
    for k in range(1, 400):
        estimator.imu(k * STEP_NS, np.zeros(3), np.array([0.0, 0.0, G]), DT)
        if k % 10 == 0:
            pose = ExternalPose(
                stamp_ns=k * STEP_NS, p=np.zeros(3), v=np.zeros(3), v_in_body=True, yaw=0.0, variance=np.full(7, 0.01),
                aligned_with_north=True, reset_counter=0, quality=100,
            )  # fmt: skip
            estimator.external_pose(pose)
    assert np.isfinite(estimator.test_ratios).sum() == fused


def test_without_any_aid_tilt_holds_and_speed_stays_small():
    rng = np.random.default_rng(2)
    estimator = Estimator(Parameters(), boot_heading=None)
    for k in range(1, 12_000):
        estimator.imu(
            k * STEP_NS,
            np.array([0.01, -0.01, 0.0]) + rng.normal(0, 0.003, 3),
            np.array([0.05, 0.0, G]) + rng.normal(0, 0.05, 3),
            DT,
        )
        if k % 4 == 0:
            estimator.hold(at_rest=True)
    assert estimator.attitude_valid
    assert not estimator.xy_valid
    assert np.abs(estimator.v).max() < 0.2
    assert np.abs(estimator.q[1:3]).max() < 0.01


def test_it_aligns_only_at_rest_and_drops_bad_samples():
    estimator = Estimator(Parameters(), boot_heading=None)
    for k in range(1, 400):
        estimator.imu(k * STEP_NS, np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.0, G]), DT)
    assert not estimator.attitude_valid
    tilted = np.array([G * math.sin(0.1), 0.0, G * math.cos(0.1)])  # nose up by 0.1 rad
    for k in range(400, 700):
        estimator.imu(k * STEP_NS, np.zeros(3), tilted, DT)
        estimator.imu(k * STEP_NS, np.full(3, np.nan), tilted, DT)
    assert estimator.attitude_valid
    assert 2 * math.asin(estimator.q[2]) == pytest.approx(0.1, abs=1e-6)
    assert np.isfinite(estimator.x).all()


def test_gps_is_fused_only_when_allowed_and_the_heading_is_known():
    for gps, heading, expected in ((1, 0.0, True), (0, 0.0, False), (1, None, False)):
        estimator = Estimator(Parameters({"SYS_HAS_GPS": gps, "EKF2_GPS_CTRL": 7}), boot_heading=heading)
        for k in range(1, 1200):
            estimator.imu(k * STEP_NS, np.zeros(3), np.array([0.0, 0.0, G]), DT)
            if k % 80 == 0:
                estimator.gps(GpsFix((5.0, 10.0, 2.0), (0.0, 0.0, 0.0)))
        assert estimator.xy_valid is expected
        if expected:
            np.testing.assert_allclose(estimator.p, [10.0, 5.0, -2.0], atol=0.05)


def test_the_barometer_holds_the_height_when_vision_is_gone():
    def silence(pose, t):
        return pose._replace(quality=-1) if t > 8.0 else pose

    estimator = run(8.0, hook=silence)[2]
    height = -float(estimator.p[2])
    estimator.baro(100.0 + height)  # its zero is learnt while vision is there
    now = 8 * 10**9
    for k in range(1, 4000):
        estimator.imu(now + k * STEP_NS, np.zeros(3), np.array([0.0, 0.0, G]), DT)
        if k % 20 == 0:
            estimator.baro(100.0 + height)
    assert estimator.z_valid
    assert -estimator.p[2] == pytest.approx(height, abs=1.0)
