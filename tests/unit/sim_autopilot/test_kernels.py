"""The kernels as mathematics: Jacobians by finite difference, covariance by dense algebra, mixing by its limits."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sim.autopilot import cascade, ekf
from sim.autopilot.allocation import allocation
from sim.autopilot.frames import (
    euler_from_quaternion,
    frd_from_flu,
    geodetic,
    local,
    ned_from_enu,
    quaternion_from_euler,
)

NOISE = np.array([0.0025, 0.0025, 0.1, 0.0, 0.0, 0.0, 0.0])  # no process noise, covariance at every step
unit = st.floats(-1, 1)
angles = st.tuples(st.floats(-1.2, 1.2), st.floats(-1.2, 1.2), st.floats(-3.1, 3.1))


def state(rng):
    x = rng.normal(0, 0.3, 16)
    x[:4] = quaternion_from_euler(*rng.uniform(-1, 1, 3))
    return x


def advance(x, gyro, accel):
    """imu_step on a copy; returns the state after it."""
    x, P = x.copy(), np.eye(15)
    ekf.imu_step(x, P, np.zeros((ekf.RING, ekf.PAST)), np.zeros(ekf.WORK), 0, gyro, accel, NOISE)
    return x, P


def add(x, d):
    """x boxplus d with the attitude error in the world frame."""
    out = x.copy()
    ekf._turn_world(out, np.ascontiguousarray(d[:3]))
    out[4:] += d[3:]
    return out


def minus(a, b):
    """The error d with a = add(b, d), small."""
    w, v = b[0], -b[1:4]
    q = np.array([a[0] * w - a[1:4] @ v, *(a[0] * v + w * a[1:4] + np.cross(a[1:4], v))])
    return np.concatenate([2 * q[1:] * np.sign(q[0]), a[4:] - b[4:]])


def test_the_covariance_follows_the_jacobian_of_the_motion():
    rng = np.random.default_rng(0)
    x, gyro, accel = state(rng), rng.normal(0, 0.3, 3), np.array([0.3, -0.2, 9.8])
    after, P = advance(x, gyro, accel)
    F = np.empty((15, 15))
    for k in range(15):
        d = np.zeros(15)
        d[k] = 1e-5
        ahead, behind = (minus(advance(add(x, e), gyro, accel)[0], after) for e in (d, -d))
        F[:, k] = (ahead - behind) / 2e-5
    np.testing.assert_allclose(P, F @ F.T, atol=3e-5)
    np.testing.assert_allclose(P, P.T, atol=1e-15)


def test_a_scalar_update_is_kalmans():
    rng = np.random.default_rng(1)
    A = rng.normal(0, 1, (15, 15))
    P = A @ A.T
    h, x = rng.normal(0, 1, 15), state(rng)
    S = h @ P @ h + 0.5
    expected = P - np.outer(P @ h, P @ h) / S
    total, past = np.zeros(15), x[:10].copy()
    ratio = ekf._fuse_row(x, P, past, h, 0.1, 0.5, 5.0, total)
    np.testing.assert_allclose(P, expected, atol=1e-9)
    assert ratio == pytest.approx(0.01 / (25 * S))
    np.testing.assert_allclose(past, x[:10], atol=1e-12)  # the past is corrected like the present


def test_an_outlier_changes_nothing():
    rng = np.random.default_rng(2)
    x, P = state(rng), np.eye(15)
    before = x.copy()
    assert ekf._fuse_row(x, P, x[:10].copy(), np.eye(15)[6], 20.0, 1.0, 5.0, np.zeros(15)) > 1.0
    np.testing.assert_array_equal(x, before)
    np.testing.assert_array_equal(P, np.eye(15))


@settings(max_examples=50, deadline=None)
@given(angles)
def test_the_heading_row_is_the_derivative_of_the_heading(a):
    q, h = quaternion_from_euler(*a), np.zeros(15)
    ekf._yaw_row(q, h)
    for k in range(3):
        plus, less = q.copy(), q.copy()
        d = np.zeros(3)
        d[k] = 1e-6
        ekf._turn_world(plus, d)
        ekf._turn_world(less, -d)
        slope = math.remainder(ekf.yaw_of(plus) - ekf.yaw_of(less), 2 * math.pi) / 2e-6
        assert h[k] == pytest.approx(slope, abs=1e-5)


@settings(max_examples=50, deadline=None)
@given(angles)
def test_euler_angles_round_trip(a):
    np.testing.assert_allclose(euler_from_quaternion(quaternion_from_euler(*a)), a, atol=1e-9)


def test_frames_and_map_are_involutions_and_inverses():
    v = np.array([1.0, 2.0, 3.0])
    np.testing.assert_array_equal(ned_from_enu(ned_from_enu(v)), v)
    np.testing.assert_array_equal(frd_from_flu(frd_from_flu(v)), v)
    np.testing.assert_array_equal(ned_from_enu(v), [2.0, 1.0, -3.0])
    origin = (47.4, 8.5, 488.0)
    np.testing.assert_allclose(local(origin, *geodetic(origin, 100 * v)), 100 * v, atol=1e-6)


@settings(max_examples=100, deadline=None)
@given(unit, unit, st.floats(0.1, 1), st.floats(-3.1, 3.1))
def test_the_attitude_has_the_thrusts_direction_and_the_heading(x, y, z, yaw):
    thrust, q = np.array([x, y, -z]), np.empty(4)
    cascade._attitude_of(thrust, yaw, q)
    R = ekf.rotation_of(q)
    np.testing.assert_allclose(-R[:, 2], thrust / np.linalg.norm(thrust), atol=1e-9)
    assert math.remainder(math.atan2(R[1, 0], R[0, 0]) - yaw, 2 * math.pi) == pytest.approx(0, abs=1e-6)


@pytest.mark.parametrize("seed", range(5))
def test_the_mixer_keeps_its_limits_and_never_adds_thrust(quad, seed):
    mixer, _ = allocation(quad)
    rng, motors = np.random.default_rng(seed), np.empty(4)
    for _ in range(200):
        torque, thrust = rng.normal(0, 0.4, 3), rng.uniform(0, 1)
        cascade._mix(torque, thrust, mixer, motors)
        assert motors.min() > -1e-12
        assert motors.max() < 1 + 1e-12
        assert motors.mean() < thrust + 1e-12
        made = np.linalg.lstsq(mixer, motors, rcond=None)[0]
        for axis in range(3):  # weaker at most, never against what was asked
            assert made[axis] * torque[axis] >= -1e-9
            assert abs(made[axis]) <= abs(torque[axis]) + 1e-9
        assert made[0] * torque[1] == pytest.approx(made[1] * torque[0], abs=1e-9)  # roll and pitch alike


def test_small_demands_pass_the_mixer_unchanged(quad):
    mixer, _ = allocation(quad)
    motors, wanted = np.empty(4), np.array([0.05, -0.04, 0.03])
    cascade._mix(wanted, 0.5, mixer, motors)
    np.testing.assert_allclose(motors, mixer @ [*wanted, 0.5], atol=1e-12)


def test_the_past_is_found_at_its_time_and_refused_beyond():
    ring, stamps, out = np.zeros((ekf.RING, ekf.PAST)), np.arange(ekf.RING) * 2_500_000, np.empty(ekf.PAST)
    ring[:, 4] = 2.0  # m/s north
    ring[:, 7] = 2.0 * stamps * 1e-9
    for stamp in (0, 1_000_000, 317_000_000, stamps[-1] + 10_000_000):
        assert ekf.past_state(ring, stamps, stamp, out) == 0
        assert out[7] == pytest.approx(2.0 * stamp * 1e-9, abs=1e-12)
    assert ekf.past_state(ring, stamps + 1_000_000_000, 0, out) == 1_000_000_000
    assert ekf.past_state(ring, stamps, stamps[-1] + 100_000_000, out) > 0
