"""Missions as uploaded over MAVLink and flown; positions in truth are ENU, those of items north and east of home."""

import math

import pytest
from pymavlink.dialects.v20 import all as dialect

from sim.autopilot.frames import geodetic

ORIGIN = (47.397742, 8.545594, 488.0)
WAYPOINT, LOITER_TIME, RETURN, LAND, TAKEOFF, DELAY, SPEED = 16, 19, 20, 21, 22, 93, 178
ACCEPTED, DENIED, MISSION_UNSUPPORTED = 0, 2, 3
NOT_STARTED, ACTIVE, PAUSED, COMPLETE = 2, 3, 4, 5
MISSION_MODE = (1, 4, 4)
NAN = math.nan


def item(command, north=NAN, east=NAN, up=NAN, *, p=(0.0, 0.0, 0.0, NAN)):
    if math.isnan(north):
        x = y = 0x7FFFFFFF
    else:
        latitude, longitude, _ = geodetic(ORIGIN, (north, east, 0.0))
        x, y = round(latitude * 1e7), round(longitude * 1e7)
    return command, p, x, y, 0.0 if math.isnan(up) else up


def upload(b, items):
    b.send(dialect.MAVLink_mission_count_message(1, 1, len(items), 0))
    for seq, (command, p, x, y, z) in enumerate(items):
        b.run(0.0025)
        b.send(dialect.MAVLink_mission_item_int_message(1, 1, seq, 6, command, 0, 1, *p, x, y, z, 0))
    b.run(0.0025)
    return b.of("MISSION_ACK")[-1].type


def ready(bench, **config):
    b = bench(**config)
    b.wait_ready()
    b.autopilot.receive(b.now_ns, dialect.MAVLink_set_gps_global_origin_message(
        1, round(ORIGIN[0] * 1e7), round(ORIGIN[1] * 1e7), round(ORIGIN[2] * 1e3)).pack(b.mav))  # fmt: skip
    return b


def reached(b):
    return [m.seq for m in b.of("MISSION_ITEM_REACHED")]


def state(b):
    return b.of("MISSION_CURRENT")[-1].mission_state


def test_a_mission_from_the_ground_takes_off_flies_its_places_and_lands(bench):
    b = ready(bench)
    plan = [
        item(TAKEOFF, up=4.0),
        item(SPEED, p=(1.0, 3.0, -1.0, NAN)),
        item(WAYPOINT, 10.0, 0.0, 4.0),
        item(WAYPOINT, 10.0, 6.0, 5.0, p=(2.0, 0.0, 0.0, NAN)),
        item(LAND, 4.0, 6.0, 0.0),
    ]
    assert upload(b, plan) == ACCEPTED
    assert b.command(176, *MISSION_MODE) == ACCEPTED
    assert b.command(400, 1) == ACCEPTED
    b.run(8.0)
    assert state(b) == ACTIVE
    b.run(52.0)
    assert reached(b) == [0, 1, 2, 3, 4]
    assert state(b) == COMPLETE
    assert not b.autopilot.armed
    ups = [t[3] for t in b.truth]
    assert 4.5 < max(ups) < 5.5
    speeds = [math.hypot(t[4], t[5]) for t in b.truth]
    assert 2.7 < max(speeds) < 4.2  # not the default, 5 m/s
    east, north = b.truth[-1][1:3]
    assert (north, east) == (pytest.approx(4.0, abs=0.6), pytest.approx(6.0, abs=0.6))
    assert "Mission finished, loitering" in b.texts()


def test_a_mission_without_take_off_item_climbs_to_its_first_place_before_it_leaves(bench):
    b = ready(bench)
    upload(b, [item(WAYPOINT, 12.0, 0.0, 6.0)])
    b.command(176, *MISSION_MODE)
    b.command(400, 1)
    b.run(25.0)
    low = [t for t in b.truth if t[3] < 4.5]
    assert max(abs(t[2]) for t in low) < 0.7
    assert b.truth[-1][2] == pytest.approx(12.0, abs=0.6)
    assert b.truth[-1][3] == pytest.approx(6.0, abs=0.6)
    assert b.autopilot.mode == "MISSION"


def test_a_paused_mission_goes_on_where_it_was(bench):
    b = ready(bench)
    upload(b, [item(WAYPOINT, 0.0, 0.0, 4.0), item(WAYPOINT, 20.0, 0.0, 4.0), item(WAYPOINT, 20.0, 10.0, 4.0)])
    b.command(176, *MISSION_MODE)
    b.command(400, 1)
    b.run(12.0)
    assert b.command(176, 1, 4, 3) == ACCEPTED
    b.run(4.0)
    assert state(b) == PAUSED
    rest = b.truth[-1][1:3]
    b.run(2.0)
    assert math.dist(rest, b.truth[-1][1:3]) < 0.3
    assert b.command(176, *MISSION_MODE) == ACCEPTED
    b.run(25.0)
    assert reached(b) == [0, 1, 2]
    assert (b.truth[-1][2], b.truth[-1][1]) == (pytest.approx(20.0, abs=0.6), pytest.approx(10.0, abs=0.6))


def test_set_current_skips_and_delay_waits(bench):
    b = ready(bench)
    plan = [item(WAYPOINT, 0.0, 0.0, 4.0), item(WAYPOINT, 90.0, 0.0, 4.0), item(DELAY, p=(3.0, 0.0, 0.0, 0.0)),
            item(WAYPOINT, 6.0, 0.0, 4.0)]  # fmt: skip
    upload(b, plan)
    b.command(176, *MISSION_MODE)
    b.command(400, 1)
    b.run(9.0)
    assert b.command(224, 7) == DENIED
    assert b.command(224, 2) == ACCEPTED
    b.run(2.9)
    assert abs(b.truth[-1][5]) < 1.5  # it brakes from 5 m/s
    b.run(20.0)
    assert reached(b)[-2:] == [2, 3]
    assert b.truth[-1][2] == pytest.approx(6.0, abs=0.6)


def test_a_return_at_the_end_flies_home_and_lands(bench):
    b = ready(bench, parameters={"RTL_RETURN_ALT": 6.0})
    upload(b, [item(WAYPOINT, 14.0, 0.0, 4.0), item(RETURN)])
    b.command(176, *MISSION_MODE)
    b.command(400, 1)
    b.run(18.0)
    assert b.autopilot.mode == "RETURN"
    b.run(40.0)
    assert not b.autopilot.armed
    assert math.hypot(*b.truth[-1][1:3]) < 1.0


def test_what_cannot_be_flown_is_refused_at_the_upload_and_an_empty_mission_at_the_start(bench):
    b = ready(bench)
    assert upload(b, [item(WAYPOINT, 0.0, 0.0, 4.0), item(84)]) == MISSION_UNSUPPORTED  # VTOL take-off
    assert b.command(300) == DENIED
    assert upload(b, [item(WAYPOINT, 0.0, 0.0, 4.0)]) == ACCEPTED
    assert b.command(300) == ACCEPTED
    b.run(1.1)
    assert state(b) == NOT_STARTED


def test_a_mission_cleared_in_flight_holds(bench):
    b = ready(bench)
    upload(b, [item(WAYPOINT, 30.0, 0.0, 4.0)])
    b.command(176, *MISSION_MODE)
    b.command(400, 1)
    b.run(10.0)
    b.send(dialect.MAVLink_mission_clear_all_message(1, 1, 0))
    b.run(0.1)
    assert b.autopilot.mode == "HOLD"
    assert b.autopilot.armed


def test_a_global_setpoint_flies_to_the_same_place_as_a_local_one(bench):
    b = ready(bench)
    b.fly_offboard()
    latitude, longitude, altitude = geodetic(ORIGIN, (4.0, 3.0, -6.0))
    b.setpoint = None
    place = round(latitude * 1e7), round(longitude * 1e7), altitude
    for _ in range(200):
        b.send(dialect.MAVLink_set_position_target_global_int_message(0, 1, 1, 5, 0b100111111000, *place, *[0.0] * 8))
        b.run(0.05)
    assert b.autopilot.mode == "OFFBOARD"
    p = b.truth[-1][1:4]
    assert p == [pytest.approx(3.0, abs=0.3), pytest.approx(4.0, abs=0.3), pytest.approx(6.0, abs=0.3)]


def test_a_take_off_to_an_altitude_below_is_raised_to_the_minimum(bench):
    b = ready(bench, parameters={"MIS_TAKEOFF_ALT": 3.0})
    assert b.command(400, 1) == ACCEPTED
    assert b.command(22, 0, 0, 0, 0, 0, 0, 5.0) == ACCEPTED  # above sea level, where the ground is at 488 m
    b.run(8.0)
    assert "Using minimum takeoff altitude: 3.00 m" in b.texts()
    assert b.truth[-1][3] == pytest.approx(3.0, abs=0.8)
    assert b.autopilot.mode == "HOLD"


def test_one_mode_is_listed_when_it_is_asked_for_by_its_number(bench):
    b = ready(bench)
    assert b.command(512, 435, 2) == ACCEPTED
    (mode,) = b.of("AVAILABLE_MODES")
    assert mode.mode_index == 2
    assert b.command(512, 435, mode.number_modes + 1) == DENIED
