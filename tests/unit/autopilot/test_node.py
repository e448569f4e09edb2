"""The node as a black box: bytes and messages in, bytes and messages out."""

from __future__ import annotations

import gzip
import math
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose
from pymavlink.dialects.v20 import all as dialect

from companion.autopilot import codec
from companion.autopilot.inspect import Record, read_tlog
from companion.autopilot.timesync import TimesyncConfig
from companion.autopilot.wire import Parser
from companion.core.geometry import quaternion_from_yaw
from companion.core.messages import MavlinkBytes, Odometry, Setpoint, VehicleCommand
from companion.core.topics import (
    COMMAND_RESULT,
    MAVLINK_RX,
    MAVLINK_TX,
    ODOMETRY,
    SETPOINT,
    VEHICLE,
    VEHICLE_COMMAND,
)
from tests.unit.autopilot.flight_bench import (
    ESTIMATOR_GOOD,
    MS,
    OFFBOARD,
    Flight,
    S,
    estimator,
    heartbeat,
    landed,
    position,
    ready_flight,
    sys_status,
)

LOGS = Path(__file__).parents[4] / "shared/data/log_mavlink_tlog"


def test_status_in_our_frames():
    status = ready_flight().tick(S).status
    assert (status.connected, status.armed, status.mode) == (True, False, "HOLD")
    assert (status.landed, status.ready, status.battery_fraction) == (True, True, 0.8)
    assert_allclose(status.p_odom, [1, 2, 3])
    assert_allclose(status.v_odom, [0.1, 0.2, 0.3], rtol=1e-6)
    assert not status.p_odom.flags.writeable


def test_nothing_is_known_before_the_first_heartbeat():
    status = Flight().tick(0).status
    assert (status.connected, status.mode, status.ready) == (False, "", False)
    assert np.isnan(status.p_odom).all() and math.isnan(status.battery_fraction)


def test_status_at_ten_hz_and_at_once_on_change():
    flight = ready_flight()
    for i in range(10):
        flight.tick(S + i * 100 * MS)
    before = len(flight.published(VEHICLE))
    flight.hear(S + 950 * MS, heartbeat(), position(), position())
    assert len(flight.published(VEHICLE)) == before
    flight.hear(S + 960 * MS, heartbeat(OFFBOARD, armed=True))
    assert len(flight.published(VEHICLE)) == before + 1
    assert (flight.status.mode, flight.status.armed) == ("OFFBOARD", True)
    flight.hear(S + 970 * MS, landed(2))
    assert not flight.status.landed


def test_disconnected_three_seconds_after_the_last_heartbeat():
    flight = ready_flight()
    assert flight.tick(4 * S).status.connected
    assert not flight.tick(4 * S + 1).status.connected
    assert flight.hear(5 * S, heartbeat()).status.connected


def test_stale_position_is_nan():
    flight = ready_flight()
    assert_allclose(flight.tick(2 * S).status.p_odom, [1, 2, 3])
    stale = flight.tick(2 * S + 1).status
    assert np.isnan(stale.p_odom).all() and np.isnan(stale.v_odom).all() and not stale.ready


@pytest.mark.parametrize("system, component", [(255, 190), (2, 1), (1, 154), (1, 191)])
def test_only_the_target_counts(system, component):
    flight = Flight()
    flight.hear(S, heartbeat(OFFBOARD, armed=True), position(), system=system, component=component).tick(S)
    assert (flight.status.connected, flight.status.armed) == (False, False)
    assert np.isnan(flight.status.p_odom).all()


@pytest.mark.parametrize(
    "changed, ready",
    [
        (sys_status(health=0), False),
        (estimator(ESTIMATOR_GOOD & ~1), False),  # no attitude
        (estimator(ESTIMATOR_GOOD & ~8), False),  # no position at all
        (estimator(ESTIMATOR_GOOD & ~8 | 16), True),  # absolute instead of relative
        (estimator(ESTIMATOR_GOOD & ~32), False),  # no height
    ],
)
def test_ready_needs_prearm_and_estimator(changed, ready):
    assert ready_flight().hear(S, changed).tick(S).status.ready is ready


def test_prearm_can_be_waived():
    assert ready_flight(require_prearm=False).hear(S, sys_status(health=0)).tick(S).status.ready


def test_ardupilot_is_recognised():
    flight = Flight()
    flags = dialect.MAVLink_ekf_status_report_message(ESTIMATOR_GOOD, 0, 0, 0, 0, 0)
    flight.hear(-S, heartbeat(4, autopilot=3)).hear(S, heartbeat(4, autopilot=3), sys_status(), flags, position()).tick(
        S
    )
    assert (flight.status.mode, flight.status.ready) == ("OFFBOARD", True)
    lost = dialect.MAVLink_ekf_status_report_message(ESTIMATOR_GOOD | 128, 0, 0, 0, 0, 0)
    assert not flight.hear(S, lost).tick(S).status.ready
    flight.sent()
    flight.feed(VEHICLE_COMMAND, VehicleCommand(stamp_ns=S, kind="hold"))
    assert [(m.param2, m.param3) for m in flight.sent(codec.CommandLong)] == [(17.0, 0.0)]


def test_status_text_joins_chunks():
    def text(words, number, chunk):
        return dialect.MAVLink_statustext_message(4, words, number, chunk)

    flight = ready_flight().hear(S, text(b"a" * 50, 7, 0), text(b" tail", 7, 1))
    assert flight.status.text == "a" * 50 + " tail"
    assert flight.hear(S, text(b"short", 0, 0)).status.text == "short"


# --- out --------------------------------------------------------------------------------


def test_heartbeat_at_one_hz_as_onboard_controller():
    flight = Flight()
    for i in range(50):
        flight.tick(i * 100 * MS)
    assert all((m.type, m.autopilot) == (18, 8) for m in flight.sent(codec.Heartbeat))
    for i in range(50, 100):
        flight.tick(i * 100 * MS)
    frames = [f for m in flight.published(MAVLINK_TX) for f in Parser().feed(m.data)]
    assert [(f.name, f.system, f.component) for f in frames] == [("HEARTBEAT", 1, 191)] * 5


def setpoint(stamp_ns=S):
    nan = np.full(3, math.nan)
    return Setpoint(stamp_ns=stamp_ns, p_odom=np.array([1.0, 2, 3]), v_odom=nan, a_odom=nan, yaw=0.0, yaw_rate=math.nan)


def test_one_setpoint_one_message_and_none_from_the_clock():
    flight = ready_flight()
    flight.feed(SETPOINT, setpoint())
    assert [(m.x, m.y, m.z) for m in flight.sent(codec.SetPositionTarget)] == [(2, 1, -3)]
    for i in range(30):
        flight.hear(S + i * 100 * MS, heartbeat(), position()).tick(S + i * 100 * MS)
    assert flight.sent(codec.SetPositionTarget) == []


def test_sequence_numbers_have_no_gap():
    flight = ready_flight()
    for i in range(300):
        flight.tick(S + i * 100 * MS).feed(SETPOINT, setpoint(S + i * 100 * MS))
    frames = [f for m in flight.published(MAVLINK_TX) for f in Parser().feed(m.data)]
    assert [f.sequence for f in frames] == [i % 256 for i in range(len(frames))]


def odometry(stamp_ns, *, reset_counter=0, x=1.0):
    return Odometry(
        stamp_ns=stamp_ns,
        p_odom=np.array([x, 2.0, 3.0]),
        q_odom_body=quaternion_from_yaw(0.3),
        v_odom=np.zeros(3),
        omega_body=np.zeros(3),
        pose_variance=np.ones(6),
        velocity_variance=np.ones(3),
        measured_ns=stamp_ns,
        quality=1.0,
        reset_counter=reset_counter,
    )


@pytest.mark.parametrize("hz", [30.0, 40.0, 50.0, 100.0])
def test_odometry_is_thinned_to_its_rate(hz):
    flight = Flight(odometry_hz=hz)
    for i in range(1000):
        flight.feed(ODOMETRY, odometry(i * 10 * MS))
    stamps = np.array([m.time_usec for m in flight.sent(codec.Odometry)])
    assert len(stamps) == pytest.approx(10 * hz, abs=1)
    assert np.diff(stamps).max() <= 1e6 / hz + 10_000


def test_odometry_resumes_after_a_gap_and_tells_a_reset_at_once():
    flight = Flight()
    for stamp_ns in (0, 10 * MS, 5 * S, 5 * S + 10 * MS):
        flight.feed(ODOMETRY, odometry(stamp_ns))
    flight.feed(ODOMETRY, odometry(5 * S + 20 * MS, reset_counter=1))
    sent = [(m.time_usec, m.reset_counter) for m in flight.sent(codec.Odometry)]
    assert sent == [(0, 0), (5_000_000, 0), (5_020_000, 1)]


def test_odometry_and_position_go_through_the_same_frame():
    """What we send as odometry comes back as the same odom position."""
    flight = ready_flight().feed(ODOMETRY, odometry(S, x=7.0))
    (m,) = flight.sent(codec.Odometry)
    flight.hear(S, position(m.x, m.y, m.z)).tick(S)
    assert_allclose(flight.status.p_odom, [7.0, 2.0, 3.0])


def test_timesync_is_answered_and_asked():
    flight = ready_flight()
    flight.sent()
    flight.hear(2 * S, dialect.MAVLink_timesync_message(0, 555))
    assert flight.sent(codec.Timesync) == [codec.Timesync(tc1=2 * S, ts1=555)]
    for i in range(10):
        flight.tick(2 * S + i * 100 * MS)
    asked = flight.sent(codec.Timesync)
    assert asked == [codec.Timesync(tc1=0, ts1=2 * S + i * 100 * MS) for i in range(10)]


@pytest.mark.parametrize("clock, expected", [("companion", 60_000_000), ("autopilot", 10_000_000)])
def test_odometry_stamps_by_either_clock(clock, expected):
    """The autopilot booted at 50 s of our clock and answers within 1 ms."""
    config = TimesyncConfig(convergence_samples=20)
    flight = ready_flight(50 * S, odometry_clock=clock, timesync=config)
    for i in range(30):
        now = 50 * S + i * 100 * MS
        flight.hear(now, heartbeat()).tick(now)
        flight.hear(now + MS, dialect.MAVLink_timesync_message(now + MS // 2 - 50 * S, now))
    flight.sent()
    flight.feed(ODOMETRY, odometry(60 * S))
    (m,) = flight.sent(codec.Odometry)
    assert m.time_usec == pytest.approx(expected, abs=10)


# --- commands ---------------------------------------------------------------------------


def ack(command, result, system=1, component=191):
    return dialect.MAVLink_command_ack_message(command, result, 0, 0, system, component)


def results(flight):
    return [(r.kind, r.accepted, r.reason) for r in flight.published(COMMAND_RESULT)]


def test_arm_and_offboard_acknowledged():
    flight = ready_flight()
    flight.feed(VEHICLE_COMMAND, VehicleCommand(stamp_ns=S, kind="offboard"))
    flight.feed(VEHICLE_COMMAND, VehicleCommand(stamp_ns=S, kind="arm"))
    sent = flight.sent(codec.CommandLong)
    assert [(m.command, m.param1, m.param2, m.target_system, m.target_component) for m in sent] == [
        (176, 1, 6, 1, 1),
        (400, 1, 0, 1, 1),
    ]
    flight.hear(S, ack(176, 0), ack(400, 1))
    assert results(flight) == [("offboard", True, ""), ("arm", False, "temporarily rejected")]


def test_acknowledgements_to_others_do_not_count():
    flight = ready_flight().feed(VEHICLE_COMMAND, VehicleCommand(stamp_ns=S, kind="arm"))
    flight.hear(S, ack(400, 0, component=190), ack(400, 0, system=255))
    assert results(flight) == []
    flight.hear(S, ack(400, 0, system=0, component=0))  # as MAVLink 1 autopilots do
    assert results(flight) == [("arm", True, "")]


def test_a_lost_command_is_sent_again_then_times_out():
    flight = ready_flight(ack_ticks=3, attempts=4, interval_requests=0)
    flight.feed(VEHICLE_COMMAND, VehicleCommand(stamp_ns=S, kind="arm"))
    for i in range(1, 30):
        flight.tick(S + i * 100 * MS)
    sent = flight.sent(codec.CommandLong)
    assert [m.confirmation for m in sent] == [0, 1, 2, 3]
    assert results(flight) == [("arm", False, "timeout")]


def test_missing_messages_are_asked_for_and_only_so_often():
    flight = Flight(interval_requests=3)
    for i in range(200):
        now = S + i * 100 * MS
        flight.hear(now, heartbeat(), landed(), position(), position(), position()).tick(now)
    asked = [(m.param1, m.param2) for m in flight.sent(codec.CommandLong) if m.command == 511]
    assert asked == [(1.0, 500_000.0), (230.0, 1_000_000.0)] * 3


# --- real logs ----------------------------------------------------------------------------


def replay(name):
    """Feed a recorded flight; the changes of (armed, mode, landed) with their times in s."""
    path = LOGS / name
    if not path.exists():
        pytest.skip("recorded logs are not here")
    log = gzip.decompress(path.read_bytes())
    records = [r for r in read_tlog(log) if isinstance(r, Record)]
    flight, changes, at = Flight(), [], 0
    start_us, next_tick = records[0].stamp_us, 0
    for stamp_us, frame in records:
        at += 8
        data, now = log[at : at + frame.size], (stamp_us - start_us) * 1000
        at += frame.size
        flight.feed(MAVLINK_RX, MavlinkBytes(stamp_ns=now, data=data))
        while now >= next_tick:
            flight.tick(next_tick)
            next_tick += 100 * MS
    for status in flight.published(VEHICLE):
        state = (status.connected, status.armed, status.mode, status.landed)
        if not changes or changes[-1][1] != state:
            changes.append((round(status.stamp_ns / 1e9, 1), state))
    return flight, changes


def test_px4_flight_reads_as_it_was_flown():
    flight, changes = replay("px4_offboard_both_directions.tlog.gz")
    times, states = zip(*changes, strict=True)
    assert states == (
        (False, False, "", True),
        (True, False, "HOLD", True),
        (True, True, "TAKEOFF", True),
        (True, True, "TAKEOFF", False),
        (True, True, "HOLD", False),
        (True, True, "OFFBOARD", False),
        (True, True, "HOLD", False),
        (True, True, "RETURN", False),
        (True, True, "LAND", False),
        (True, True, "LAND", True),
        (True, False, "HOLD", True),
    )
    seen = [0, 1.01, 5.05, 7.07, 12.13, 13.13, 32.46, 132.78, 136.83, 145.95, 147.97]
    assert_allclose(times, seen, atol=0.06)
    ready = [s.stamp_ns for s in flight.published(VEHICLE) if s.ready]
    assert min(ready) / 1e9 == pytest.approx(3.43, abs=0.05)  # SYS_STATUS turns its prearm bit on
    height = max(s.p_odom[2] for s in flight.published(VEHICLE) if not np.isnan(s.p_odom[2]))
    assert 5.5 < height < 11


def test_arducopter_flight_reads_as_it_was_flown():
    _, changes = replay("arducopter_guided_both_directions.tlog.gz")
    modes = [state[2] for _, state in changes]
    assert "OFFBOARD" in modes and any(state[1] and state[2] == "OFFBOARD" for _, state in changes)
    assert any(state[1] and not state[3] for _, state in changes)


def test_senseless_content_from_the_target_breaks_nothing():
    encoder = codec.Encoder(system=1, component=1)
    rng = np.random.default_rng(12)
    flight = ready_flight()
    flight.feed(VEHICLE_COMMAND, VehicleCommand(stamp_ns=S, kind="arm"))
    for i in range(4000):
        now = S + i * 10 * MS
        msg_id = int(rng.choice([0, 1, 32, 77, 111, 147, 193, 230, 245, 253]))
        data = encoder.frame(msg_id, rng.bytes(int(rng.integers(1, 256))))
        flight.feed(MAVLINK_RX, MavlinkBytes(stamp_ns=now, data=data))
        if i % 10 == 0:
            flight.tick(now).feed(SETPOINT, setpoint(now)).feed(ODOMETRY, odometry(now))
    assert 0.0 <= flight.status.battery_fraction <= 1.0
    flight.sent()
    end = S + 4000 * 10 * MS
    flight.hear(end, heartbeat()).feed(SETPOINT, setpoint(end))  # disarmed: it may stream again
    assert len(flight.sent(codec.SetPositionTarget)) == 1
