"""Whole flights: step responses of the design, accuracy, robustness of the link, telemetry, determinism."""

import hashlib
import math

import numpy as np
import pytest
from pymavlink.dialects.v20 import all as dialect

from sim.autopilot.allocation import allocation
from sim.autopilot.codec import LAYOUTS, Encoder
from sim.autopilot.params import DEFAULTS
from sim.autopilot.telemetry import RATES_HZ
from sim.vehicle.wind import WindConfig


def response(bench, before, after, seconds, column, **config):
    """Times from the step and the truth's column (0 t, 1-3 p ENU, 4-6 v ENU), from its start."""
    b = bench(**config)
    b.fly_offboard()
    b.setpoint = before
    b.run(2.0)
    start = len(b.truth)
    b.setpoint = after
    b.run(seconds)
    truth = np.array(b.truth[start:])
    return truth[:, 0] - truth[0, 0], truth[:, column] - truth[0, column]


def rise_time(t, x, target):
    return t[np.argmax(x >= 0.9 * target)]


def test_a_position_step_of_5_m_as_in_the_design(bench):
    here, there = {"p": (0.0, 0.0, -5.0), "yaw": 0.0}, {"p": (5.0, 0.0, -5.0), "yaw": 0.0}
    t, north = response(bench, here, there, 9.0, 2)
    assert rise_time(t, north, 5.0) == pytest.approx(2.9, rel=0.15)
    assert north.max() < 5.2
    assert np.abs(north[-400:] - 5.0).max() < 0.15


def test_a_velocity_step_of_2_m_s_as_in_the_design(bench):
    still, moving = {"v": (0.0, 0.0, 0.0), "yaw": 0.0}, {"v": (2.0, 0.0, 0.0), "yaw": 0.0}
    t, speed = response(bench, still, moving, 5.0, 5)
    assert rise_time(t, speed, 2.0) == pytest.approx(1.34, rel=0.15)
    assert speed.max() < 2.2


def test_acceleration_feed_forward_is_added(bench):
    still = {"v": (0.0, 0.0, 0.0), "yaw": 0.0}
    _, plain = response(bench, still, {"v": (2.0, 0.0, 0.0), "yaw": 0.0}, 0.8, 5)
    _, pushed = response(bench, still, {"v": (2.0, 0.0, 0.0), "a": (2.0, 0.0, 0.0), "yaw": 0.0}, 0.8, 5)
    assert pushed[-1] > plain[-1] + 0.4


def test_position_and_velocity_demands_add_up(bench):
    """A moving target with its velocity is followed without the lag that position alone would have."""
    b = bench()
    b.fly_offboard()
    start = b.now_ns
    for _ in range(250):
        t = (b.now_ns - start) * 1e-9
        b.setpoint = {"p": (1.5 * t, 0.0, -5.0), "v": (1.5, 0.0, 0.0), "yaw": 0.0}
        b.run(0.02)
    lag = 1.5 * (b.now_ns - start) * 1e-9 - b.vehicle.p_world[1]
    assert abs(lag) < 0.25  # position alone: 1.5 / 0.65 = 2.3 m


def test_a_body_velocity_follows_the_heading(bench):
    b = bench()
    b.fly_offboard()
    b.setpoint = {"p": (0.0, 0.0, -5.0), "yaw": math.pi / 2}
    b.run(4.0)
    b.setpoint = {"v": (1.0, 0.0, 0.0), "frame": 8, "yaw": math.pi / 2}
    b.run(4.0)
    np.testing.assert_allclose(b.vehicle.v_world, [1.0, 0.0, 0.0], atol=0.15)  # east


def test_an_incomplete_setpoint_stops_the_vehicle(bench):
    b = bench()
    b.fly_offboard()
    b.setpoint = {"v": (2.0, 0.0, 0.0), "yaw": 0.0}
    b.run(3.0)
    b.setpoint = {"v": (2.0, math.nan, 0.0), "yaw": 0.0}
    b.run(5.0)
    assert np.abs(b.vehicle.v_world).max() < 0.15


def test_a_yaw_rate_turns(bench):
    b = bench()
    b.fly_offboard()
    b.setpoint = {"p": (0.0, 0.0, -5.0), "yaw_rate": 0.5}
    b.run(3.0)
    assert b.vehicle.omega_body[2] == pytest.approx(-0.5, abs=0.1)


def test_it_holds_its_place_in_wind_with_late_odometry_at_10_hz(bench):
    b = bench(odometry_hz=10, odometry_delay_ms=60, wind=WindConfig(mean_m_s=5.0, gust_m_s=1.0))
    b.fly_offboard()
    b.run(10.0)
    truth = np.array(b.truth)[-4000:, 1:4]
    assert np.abs(truth - [0.0, 0.0, 5.0]).max() < 0.7
    estimate = np.array(b.estimate)[-4000:, :3]
    error = np.linalg.norm(estimate - truth[:, [1, 0, 2]] * [1, 1, -1], axis=1)
    assert np.percentile(error, 95) < 0.15


def test_the_mixer_inverts_the_airframe(quad):
    mixer, torque = allocation(quad)
    thrust = mixer * quad.max_thrust_n
    x, y = quad.rotor_xy_m.T
    np.testing.assert_allclose(thrust.T @ y, [torque[0], 0, 0, 0], atol=1e-12)  # roll, FRD
    np.testing.assert_allclose(thrust.T @ x, [0, torque[1], 0, 0], atol=1e-12)
    np.testing.assert_allclose(thrust.T @ quad.rotor_spin * quad.torque_per_thrust_m, [0, 0, torque[2], 0], atol=1e-12)
    np.testing.assert_allclose(thrust.sum(axis=0), [0, 0, 0, 4 * quad.max_thrust_n], atol=1e-9)


def test_telemetry_comes_at_its_rates_and_reads_as_pymavlink_writes_it(bench):
    b = bench()
    b.fly_offboard()
    start, sent = len(b.messages), len(b.sent)
    b.run(10.0)
    window = b.messages[start:]
    for name, rate in RATES_HZ.items():
        count = sum(m.get_type() == name for m in window)
        silent = name in ("GPS_RAW_INT", "GLOBAL_POSITION_INT", "DISTANCE_SENSOR")  # no GPS, no range finder
        assert count == pytest.approx(0 if silent else 10 * rate, abs=1), name
    rewriter = dialect.MAVLink(None, srcSystem=1, srcComponent=1)
    data = b.sent[sent:]
    for message in window:
        rewriter.seq = message.get_seq()
        packed = message.pack(rewriter)
        assert data.startswith(packed), message
        data = data[len(packed) :]
    assert data == b""


def test_telemetry_tells_the_truth_within_the_estimator(bench):
    b = bench()
    b.fly_offboard(p=(1.0, 2.0, -4.0))
    b.setpoint = {"p": (1.0, 2.0, -4.0), "yaw": 0.7}
    b.run(5.0)
    local, attitude, quaternion = (b.of(n)[-1] for n in ("LOCAL_POSITION_NED", "ATTITUDE", "ATTITUDE_QUATERNION"))
    np.testing.assert_allclose([local.x, local.y, local.z], [1.0, 2.0, -4.0], atol=0.15)
    assert attitude.yaw == pytest.approx(0.7, abs=0.05)
    assert 2 * math.atan2(quaternion.q4, quaternion.q1) == pytest.approx(0.7, abs=0.05)
    assert b.of("HIGHRES_IMU")[-1].zacc == pytest.approx(-9.8, abs=1.5)
    assert abs(local.time_boot_ms - b.own_ns // 1_000_000) < 50  # autopilot time, not the companion's
    shaken = b.of("VIBRATION")[-1]
    assert 0.1 < shaken.vibration_z < 10.0  # rotors turn
    assert b.of("VIBRATION")[0].vibration_z < 0.1
    target = b.of("POSITION_TARGET_LOCAL_NED")[-1]
    assert (target.x, target.y, target.z) == (1.0, 2.0, -4.0)
    assert target.type_mask == 0b111111000 | 1 << 11
    assert b.of("ESTIMATOR_STATUS")[-1].flags & 0x3F == 0x3F
    assert b.of("HOME_POSITION")[-1].latitude == pytest.approx(473977420, abs=100)


def test_garbage_and_mutations_never_raise_and_never_move_it(bench):
    b = bench()
    b.fly_offboard()
    rng = np.random.default_rng(5)
    samples = [b.target(p=(50, 0, -5)).pack(b.mav), b.target(v=(9, 9, 9)).pack(b.mav)]
    samples += [dialect.MAVLink_command_long_message(1, 1, n, 0, *[1.0] * 7).pack(b.mav) for n in (400, 176, 22)]
    for _ in range(1500):
        data = bytearray(samples[rng.integers(len(samples))])
        for _ in range(rng.integers(1, 6)):
            data[rng.integers(len(data))] = rng.integers(256)
        b.autopilot.receive(b.now_ns, bytes(data[: rng.integers(1, len(data) + 1)]))
        b.autopilot.receive(b.now_ns, rng.integers(0, 256, rng.integers(0, 40), np.uint8).tobytes())
        b.setpoint = {"p": (0.0, 0.0, -5.0), "yaw": 0.0}
        b.run(0.0025)
    b.run(3.0)
    assert b.autopilot.mode == "OFFBOARD"
    np.testing.assert_allclose(b.vehicle.p_world, [0.0, 0.0, 5.0], atol=0.2)


def test_intact_frames_with_any_values_never_raise(bench):
    """Every message of the dialect, filled with extremes and NaN, from a stranger."""
    b = bench()
    b.run(1.5)
    encoder = Encoder(system=255, component=190)
    for layout in LAYOUTS.values():
        for fill in (0x00, 0x01, 0x7F, 0xFF):
            size = layout.packer.size
            values = layout.packer.unpack(bytes([fill]) * size)
            b.autopilot.receive(b.now_ns, encoder(layout, *values))
        b.run(0.0025)
    assert np.isfinite(b.autopilot.estimator.x).all()
    assert np.isfinite(b.motors).all()


def test_absurd_demands_and_poses_keep_everything_finite(bench):
    b = bench()
    b.fly_offboard()
    huge = 3e38
    poses = ({"x": huge}, {"vx": -huge}, {"q": [0.0] * 4}, {"q": [huge] * 4}, {"z": math.nan, "vy": math.inf})
    others = ({"pose_covariance": [huge] * 21}, {"pose_covariance": [-1.0] * 21}, {"time_usec": 2**63})
    for changes in (*poses, *others):
        b.odometry = changes
        b.run(0.1)
    b.odometry = {}
    for field in ("p", "v", "a"):
        for sign in (1, -1):
            b.setpoint = {field: (sign * huge, sign * huge, -5.0), "yaw": huge, "yaw_rate": huge}
            b.run(0.1)
    assert np.isfinite(b.autopilot.estimator.x).all()
    assert np.isfinite(b.motors).all()
    assert b.autopilot.mode == "OFFBOARD"


def test_no_value_of_any_parameter_raises_in_flight(bench):
    b = bench()
    b.fly_offboard()
    for name in sorted(DEFAULTS):
        for value in (0.0, 1.0, -1.0, 1e-3, 1e9, 3e38, math.inf, math.nan):
            b.send(
                dialect.MAVLink_param_set_message(
                    1, 1, name.encode(), value, 9 if isinstance(DEFAULTS[name], float) else 6
                )
            )
            b.run(0.01)
            assert np.isfinite(b.motors).all(), (name, value)
        b.autopilot.parameters.set(name, DEFAULTS[name])


def test_every_command_with_any_parameters_is_answered(bench):
    b = bench()
    b.wait_ready()
    for number in (20, 21, 22, 115, 176, 178, 179, 192, 300, 400, 510, 511, 512, 520, 611, 7777):
        for value in (math.nan, math.inf, -1.0, 0.0, 1e30, 3e38):
            assert b.command(number, *[value] * 7) in range(5), (number, value)
            for frame in (0, 1, 6, 255):
                message = dialect.MAVLink_command_int_message(
                    1, 1, frame, number, 0, 0, *[value] * 4, 2**31 - 1, -(2**31), value
                )
                b.send(message)
    b.run(0.1)


def test_two_runs_give_the_same_bytes_another_seed_others(bench):
    def digest(seed):
        b = bench(seed=seed)
        b.fly_offboard()
        return hashlib.sha256(b.sent + b.vehicle.p_world.tobytes()).hexdigest()

    assert digest(1) == digest(1)
    assert digest(1) != digest(2)


def test_missions_fences_and_rally_points_are_kept_and_given_back(bench):
    b = bench()
    b.run(0.6)
    items = [
        dialect.MAVLink_mission_item_int_message(1, 1, k, 6, 16, 0, 1, 0, 0, 0, 0, 470000000 + k, 80000000, 5.0 + k, 0)
        for k in range(3)
    ]
    b.send(dialect.MAVLink_mission_count_message(1, 1, 3, 0))
    for k in range(3):
        b.run(0.0025)
        assert b.of("MISSION_REQUEST_INT")[-1].seq == k
        if k == 1:
            b.run(0.6)  # the item is lost: it is asked for again
            assert [m.seq for m in b.of("MISSION_REQUEST_INT")][-2:] == [1, 1]
        b.send(items[k])
    b.run(0.0025)
    assert b.of("MISSION_ACK")[-1].type == 0
    b.send(dialect.MAVLink_mission_request_list_message(1, 1, 0))
    b.run(0.0025)
    assert b.of("MISSION_COUNT")[-1].count == 3
    for k in range(3):
        b.send(dialect.MAVLink_mission_request_int_message(1, 1, k, 0))
        b.run(0.0025)
        given = b.of("MISSION_ITEM_INT")[-1]
        assert (given.seq, given.x, given.z) == (k, 470000000 + k, 5.0 + k)
        assert (given.target_system, given.target_component) == (1, 191)
    b.send(dialect.MAVLink_mission_clear_all_message(1, 1, 0))
    b.send(dialect.MAVLink_mission_request_list_message(1, 1, 0))
    b.run(0.0025)
    assert b.of("MISSION_COUNT")[-1].count == 0


def test_file_transfer_is_refused_at_once(bench):
    b = bench()
    b.run(0.1)
    b.send(dialect.MAVLink_file_transfer_protocol_message(0, 1, 1, [5, 0, 0, 4, *[0] * 247]))
    b.run(0.0025)
    answer = b.of("FILE_TRANSFER_PROTOCOL")[-1].payload
    assert answer[:6] == [6, 0, 0, 129, 1, 4]
    assert answer[12] == 7


def test_a_flight_under_px4s_own_position_gains_is_faster(bench):
    stock = {"MPC_XY_P": 0.95, "MPC_XY_VEL_I_ACC": 0.4}
    here, there = {"p": (0.0, 0.0, -5.0), "yaw": 0.0}, {"p": (5.0, 0.0, -5.0), "yaw": 0.0}
    t, north = response(bench, here, there, 6.0, 2, parameters=stock)
    assert rise_time(t, north, 5.0) == pytest.approx(1.9, rel=0.1)
