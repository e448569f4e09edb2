"""Arming, modes, commands and failsafes, over the link, with the real vehicle below."""

import math

import numpy as np
import pytest
from pymavlink.dialects.v20 import all as dialect

NAN = math.nan
ACCEPTED, TEMPORARILY_REJECTED, DENIED, UNSUPPORTED = 0, 1, 2, 3
OFFBOARD, HOLD, LAND, RETURN, TAKEOFF = (6, 0), (4, 3), (4, 6), (4, 5), (4, 2)
LOCAL = ("LOCAL_NED", 1)


def set_mode(b, mode):
    return b.command(176, 1, *mode)


def heartbeat_mode(b):
    custom = b.of("HEARTBEAT")[-1].custom_mode
    return custom >> 16 & 0xFF, custom >> 24


# --- arming ----------------------------------------------------------------------------


def test_arming_is_denied_before_the_attitude_is_aligned(bench):
    b = bench()
    b.run(0.1)
    assert b.command(400, 1) == TEMPORARILY_REJECTED
    assert b.texts() == ["Preflight Fail: attitude not aligned"]
    assert not b.autopilot.armed


def test_arming_is_denied_without_odometry_and_says_so(bench):
    b = bench()
    b.odometry_on = False
    b.run(2.0)
    assert b.command(400, 1) == TEMPORARILY_REJECTED
    assert "Preflight Fail: no valid local position estimate" in b.texts()
    assert b.of("SYS_STATUS")[-1].onboard_control_sensors_health & (1 << 28) == 0
    b.odometry_on = True
    b.run(1.0)
    assert b.command(400, 1) == ACCEPTED
    assert b.of("SYS_STATUS")[-1].onboard_control_sensors_health & (1 << 28) != 0


def test_arming_is_denied_when_the_vehicle_lies_on_its_side(bench):
    b = bench()
    b.wait_ready()
    b.autopilot.estimator.x[:4] = math.cos(0.6), math.sin(0.6), 0.0, 0.0  # 69 degrees of roll
    b.send(dialect.MAVLink_command_long_message(1, 1, 400, 0, 1, *[NAN] * 6))
    assert not b.autopilot.armed
    b.run(0.0025)
    assert "Preflight Fail: not upright" in b.texts()


def test_arming_is_denied_with_an_empty_battery(bench):
    b = bench(parameters={"BAT1_V_EMPTY": 4.2, "BAT1_V_CHARGED": 4.3})
    b.run(15.0)
    assert b.command(400, 1) == TEMPORARILY_REJECTED
    assert b.texts()[-1] == "Preflight Fail: battery critical"


def test_force_skips_the_checks(bench):
    b = bench()
    b.run(0.1)
    assert b.command(400, 1, 21196) == ACCEPTED


def test_armed_on_the_ground_without_a_wish_to_fly_it_disarms(bench):
    b = bench()
    b.wait_ready()
    assert b.command(400, 1) == ACCEPTED
    assert b.of("HEARTBEAT")[-1].base_mode & 128
    b.run(9.5)
    assert b.autopilot.armed
    assert (b.motors > 0).all()
    b.run(1.0)
    assert not b.autopilot.armed
    assert not b.of("HEARTBEAT")[-1].base_mode & 128
    assert not b.motors.any()
    assert b.vehicle.p_world[2] < 0.15


def test_disarming_in_the_air_needs_force(bench):
    b = bench()
    b.fly_offboard()
    assert b.command(400, 0) == DENIED
    assert b.texts()[-1] == "Disarming denied! Not landed"
    assert b.command(400, 0, 21196) == ACCEPTED
    assert not b.motors.any()


# --- modes and commands ------------------------------------------------------------------


def test_offboard_needs_a_stream(bench):
    b = bench()
    b.wait_ready()
    assert set_mode(b, OFFBOARD) == DENIED
    assert b.texts()[-1] == "Switching to offboard denied: no offboard signal"
    b.send(b.target(p=(0, 0, -2)))
    b.run(0.4)
    assert set_mode(b, OFFBOARD) == ACCEPTED
    b.run(0.3)  # a stream that has stopped again does not do
    assert set_mode(b, OFFBOARD) == DENIED


def test_refused_setpoints_do_not_make_a_stream(bench):
    b = bench()
    b.wait_ready()
    for message in (b.target(p=(0, 0, -2), frame=12), b.target(p=(0, 0, -2), system=9), b.target(mask=0x1FF)):
        b.send(message)
        assert set_mode(b, OFFBOARD) == DENIED
    warnings = [t for t in b.texts() if t.startswith("SET_POSITION")]
    assert warnings == ["SET_POSITION_TARGET_LOCAL_NED coordinate frame 12 ", "SET_POSITION_TARGET_LOCAL_NED invalid"]


@pytest.mark.parametrize(("mode", "answer"), [((1, 0), 1), ((3, 0), 1), ((4, 4), 2), ((9, 9), 2), ((4, 3), 0)])
def test_modes_on_the_ground(bench, mode, answer):
    b = bench()
    b.wait_ready()
    assert set_mode(b, mode) == answer


def test_take_off_hold_reposition_turn_land(bench):
    b = bench(parameters={"MIS_TAKEOFF_ALT": 3.0})
    b.wait_ready()
    start = b.vehicle.p_world[2]
    assert b.command(400, 1) == ACCEPTED
    assert b.command(22) == ACCEPTED
    b.run(0.1)
    assert heartbeat_mode(b) == TAKEOFF
    b.run(8.0)
    assert heartbeat_mode(b) == HOLD
    assert b.vehicle.p_world[2] - start == pytest.approx(3.0, abs=0.15)
    assert b.of("EXTENDED_SYS_STATE")[-1].landed_state == 2

    b.send(dialect.MAVLink_command_int_message(1, 1, 1, 192, 0, 0, NAN, 1, NAN, NAN, 40000, -20000, -4.0))
    b.run(8.0)
    np.testing.assert_allclose(b.vehicle.p_world, [-2.0, 4.0, 4.0], atol=0.2)  # ENU

    assert b.command(115, 90, 0, 0, 0) == ACCEPTED
    b.run(4.0)
    assert b.of("ATTITUDE")[-1].yaw == pytest.approx(math.pi / 2, abs=0.05)

    assert b.command(21) == ACCEPTED
    b.run(14.0)
    assert not b.autopilot.armed
    assert b.vehicle.on_ground
    assert b.vehicle.contact == ""
    assert b.of("EXTENDED_SYS_STATE")[-1].landed_state == 1
    assert "Disarmed by landing" in b.texts()


def test_reposition_by_latitude_and_longitude(bench):
    b = bench()
    b.fly_offboard()
    degrees = math.degrees(3.0 / 6_371_000.0)
    x, y = round((47.397742 + degrees) * 1e7), round(8.545594 * 1e7)
    b.send(dialect.MAVLink_command_int_message(1, 1, 6, 192, 0, 0, NAN, 1, NAN, NAN, x, y, 6.0))
    b.run(8.0)
    assert b.autopilot.mode == "HOLD"
    np.testing.assert_allclose(b.vehicle.p_world, [0.0, 3.0, 6.0], atol=0.3)


def test_return_climbs_flies_home_and_lands(bench):
    b = bench(parameters={"RTL_RETURN_ALT": 8.0})
    b.fly_offboard(p=(0.0, 14.0, -5.0))
    assert b.command(20) == ACCEPTED
    b.setpoint = None
    b.run(4.0)
    assert b.vehicle.p_world[2] > 7.0
    b.run(26.0)
    assert not b.autopilot.armed
    assert np.hypot(*b.vehicle.p_world[:2]) < 0.6
    assert b.vehicle.contact == ""


def test_hold_stops_from_speed_without_coming_back(bench):
    b = bench()
    b.fly_offboard()
    b.setpoint = {"v": (4.0, 0.0, 0.0), "yaw": 0.0}
    b.run(5.0)
    at = b.vehicle.p_world[1]
    assert set_mode(b, HOLD) == ACCEPTED
    b.setpoint = None
    b.run(6.0)
    assert np.abs(b.vehicle.v_world).max() < 0.1
    assert 2.0 < b.vehicle.p_world[1] - at < 6.0


def test_sticks_fly_position_mode_and_its_loss_is_held(bench):
    b = bench()
    b.fly_offboard()
    stick = dialect.MAVLink_manual_control_message(1, 200, 0, 500, 0, 0)
    b.send(stick)
    assert set_mode(b, (3, 0)) == ACCEPTED
    for _ in range(40):
        b.send(stick)
        b.run(0.1)
    assert b.vehicle.v_world[1] == pytest.approx(2.0, abs=0.25)
    b.run(1.5)
    assert b.autopilot.mode == "HOLD"
    assert "Failsafe: manual control lost" in b.texts()


def test_requests_for_messages_and_intervals(bench):
    b = bench()
    b.wait_ready()
    assert b.command(512, 148) == ACCEPTED
    version = b.of("AUTOPILOT_VERSION")[-1]
    assert version.flight_sw_version == 17956928 + 255 or version.flight_sw_version >> 16 == 0x0112
    assert version.capabilities & dialect.MAV_PROTOCOL_CAPABILITY_PARAM_ENCODE_BYTEWISE
    assert b.command(520, 1) == ACCEPTED
    assert len(b.of("AUTOPILOT_VERSION")) == 2
    assert b.command(511, 105, 5000) == ACCEPTED
    before = len(b.of("HIGHRES_IMU"))
    b.run(1.0)
    assert len(b.of("HIGHRES_IMU")) - before == pytest.approx(200, abs=2)
    assert b.command(510, 105) == ACCEPTED
    assert b.of("MESSAGE_INTERVAL")[-1].interval_us == 5000
    assert b.command(511, 105, -1) == ACCEPTED
    before = len(b.of("HIGHRES_IMU"))
    b.run(1.0)
    assert len(b.of("HIGHRES_IMU")) == before
    assert b.command(511, 105, 0) == ACCEPTED
    b.run(1.0)
    assert len(b.of("HIGHRES_IMU")) - before == pytest.approx(50, abs=1)
    assert b.command(512, 435) == ACCEPTED
    assert {m.mode_name for m in b.of("AVAILABLE_MODES")} >= {"offboard", "hold", "land", "return", "takeoff"}


@pytest.mark.parametrize("number", [519, 31010, 241, 16])
def test_unknown_commands_are_answered(bench, number):
    b = bench()
    b.run(0.6)
    assert b.command(number) == UNSUPPORTED


def test_commands_for_others_are_not_answered(bench):
    b = bench()
    b.run(0.6)
    assert b.command(400, 1, target_system=2) is None
    assert b.command(400, 1, target_component=190) is None


# --- failsafes ---------------------------------------------------------------------------


@pytest.mark.parametrize(("action", "mode"), [(5, HOLD), (4, LAND), (3, RETURN), (0, RETURN)])
def test_the_loss_of_the_offboard_stream(bench, action, mode):
    b = bench(parameters={"COM_OBL_RC_ACT": action})
    b.fly_offboard()
    b.setpoint = None
    b.run(0.9)
    assert heartbeat_mode(b) == OFFBOARD
    b.run(0.15)
    assert heartbeat_mode(b) == mode
    assert b.of("HEARTBEAT")[-1].system_status == 5
    assert "Failsafe: offboard signal lost" in b.texts()
    b.setpoint = {"p": (0.0, 0.0, -5.0)}
    b.run(0.5)
    assert heartbeat_mode(b) == mode  # it does not come back by itself
    assert set_mode(b, OFFBOARD) == ACCEPTED
    assert b.of("HEARTBEAT")[-1].system_status == 4


def test_wrong_frames_end_in_the_loss_failsafe(bench):
    b = bench()
    b.fly_offboard()
    b.setpoint = {"v": (1.0, 0.0, 0.0), "frame": 12}
    b.run(1.2)
    assert b.autopilot.mode == "HOLD"


def test_lost_odometry_descends_after_4_8_s_and_lands(bench):
    b = bench()
    b.fly_offboard(p=(0.0, 0.0, -3.0))
    b.odometry_on = False
    b.run(4.7)
    assert b.autopilot.mode == "OFFBOARD"
    b.run(0.2)
    assert b.autopilot.mode == "DESCEND"
    assert heartbeat_mode(b) == LAND
    assert b.of("ESTIMATOR_STATUS")[-1].flags & 16
    b.run(14.0)
    assert not b.of("ESTIMATOR_STATUS")[-1].flags & 16
    assert b.vehicle.on_ground
    assert not b.autopilot.armed


def test_a_lidar_estimator_type_is_refused_with_a_warning_per_message(bench):
    b = bench()
    b.odometry = {"estimator_type": 8}
    b.run(2.0)
    assert not b.autopilot.estimator.xy_valid
    warnings = [t for t in b.texts() if t == "ODOMETRY: estimator_type 8 unsupported"]
    assert len(warnings) == 800 // b.odometry_every


def test_a_critical_battery_lands_if_told_to(bench):
    b = bench(parameters={"COM_LOW_BAT_ACT": 2})
    b.fly_offboard()
    b.autopilot.parameters.set("BAT1_V_EMPTY", 4.1)
    b.autopilot.parameters.set("BAT1_V_CHARGED", 4.2)
    b.run(10.0)
    assert {"Low battery level", "Critical battery", "Failsafe: battery critical"} <= set(b.texts())
    assert b.autopilot.mode in ("LAND", "HOLD")
