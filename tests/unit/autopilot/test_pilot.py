"""The pilot always wins, is told what happens, and two companions never command the same autopilot."""

from __future__ import annotations

import numpy as np
import pytest
from pymavlink.dialects.v20 import all as dialect

from companion.autopilot import codec
from companion.autopilot.authority import Authority
from companion.autopilot.boot_clock import BootClock
from companion.autopilot.texts import News, Severity, pieces
from companion.core.messages import MavlinkBytes, MissionStatus, SafetyStatus, Setpoint, VehicleCommand
from companion.core.topics import (
    COMMAND_RESULT,
    MAVLINK_RX,
    MAVLINK_TX,
    MISSION,
    SAFETY,
    SETPOINT,
    VEHICLE_COMMAND,
    WHY,
)
from tests.unit.autopilot.flight_bench import HOLD, MS, OFFBOARD, Flight, S, heartbeat, landed, position, ready_flight

POSITION, LAND = 3 << 16, 4 << 16 | 6 << 24
SET_MODE = 176


def command(kind, now_ns):
    return VehicleCommand(stamp_ns=now_ns, kind=kind)


def setpoint(now_ns):
    nan = np.full(3, np.nan)
    return Setpoint(stamp_ns=now_ns, p_odom=np.zeros(3), v_odom=nan, a_odom=nan, yaw=0.0, yaw_rate=np.nan)


def flying(now_ns=S):
    """In OFFBOARD because we asked, armed, in the air."""
    flight = ready_flight(now_ns).feed(VEHICLE_COMMAND, command("offboard", now_ns))
    flight.hear(now_ns, heartbeat(OFFBOARD), dialect.MAVLink_command_ack_message(SET_MODE, 0, 0, 0, 1, 191))
    flight.feed(VEHICLE_COMMAND, command("arm", now_ns))
    flight.hear(now_ns, dialect.MAVLink_command_ack_message(400, 0, 0, 0, 1, 191))
    flight.hear(now_ns, heartbeat(OFFBOARD, armed=True), landed(2))
    flight.out.clear()
    return flight


def setpoints(flight, now_ns):
    return len(flight.feed(SETPOINT, setpoint(now_ns)).sent(codec.SetPositionTarget))


def texts(flight):
    """Texts that went out, put together as a ground station does."""
    station = dialect.MAVLink(None)
    found = station.parse_buffer(b"".join(m.data for m in flight.published(MAVLINK_TX))) or []
    joined: list[str] = []
    for m in found:
        if m.get_type() == "STATUSTEXT":
            if m.id and m.chunk_seq:
                joined[-1] += m.text
            else:
                joined.append(m.text)
    return joined


def refusals(flight):
    return [(r.kind, r.reason) for r in flight.published(COMMAND_RESULT) if not r.accepted]


# --- takeover ---------------------------------------------------------------------------


def test_a_pilot_who_takes_over_gets_neither_setpoints_nor_commands():
    flight = flying()
    assert setpoints(flight, S) == 1
    flight.hear(2 * S, heartbeat(POSITION, armed=True))
    assert texts(flight) == ["companion: POSITION is not ours, setpoints stop"]
    assert setpoints(flight, 2 * S) == setpoints(flight, 2 * S) == 0
    assert [(w.what, w.because) for w in flight.published(WHY)] == [
        ("command no more", "the pilot or the autopilot took over: mode POSITION"),
        ("send no setpoints", "the pilot or the autopilot took over: mode POSITION"),
    ]
    for kind in ("offboard", "arm", "land", "hold"):
        flight.feed(VEHICLE_COMMAND, command(kind, 2 * S))
    assert flight.sent(codec.CommandLong) == []
    assert refusals(flight) == [
        (k, "the pilot or the autopilot took over: mode POSITION") for k in ("offboard", "arm", "land", "hold")
    ]


def test_what_waits_for_an_answer_is_not_sent_again_over_the_pilots_head():
    flight = flying()
    flight.feed(VEHICLE_COMMAND, command("land", S))
    flight.hear(S + 100 * MS, heartbeat(POSITION, armed=True))
    flight.out.clear()
    for i in range(30):
        flight.tick(S + i * 100 * MS)
    assert [m for m in flight.sent(codec.CommandLong) if m.command == SET_MODE] == []


def test_restarted_in_flight_it_leaves_the_vehicle_to_its_failsafe():
    """Streaming again would keep the vehicle in OFFBOARD, with no mission that ever brings it down."""
    flight = ready_flight().hear(S, heartbeat(OFFBOARD, armed=True), landed(2))
    assert setpoints(flight, S) == setpoints(flight, 2 * S) == 0
    assert [w.because for w in flight.published(WHY)] == ["it flies, and not because we asked"]
    assert setpoints(flight.hear(3 * S, landed(1)), 3 * S) == 1


def test_what_is_done_is_not_asked_for_again_when_the_answer_got_lost():
    flight = ready_flight().feed(VEHICLE_COMMAND, command("offboard", S)).feed(VEHICLE_COMMAND, command("arm", S))
    flight.hear(S + 100 * MS, heartbeat(OFFBOARD)).hear(S + 500 * MS, heartbeat(OFFBOARD, armed=True))
    assert [(r.kind, r.accepted) for r in flight.published(COMMAND_RESULT)] == [("offboard", True), ("arm", True)]
    flight.sent()
    for i in range(30):
        flight.tick(S + 500 * MS + i * 100 * MS)
    flight.feed(VEHICLE_COMMAND, command("offboard", 2 * S))
    assert [m for m in flight.sent(codec.CommandLong) if m.command in (SET_MODE, 400)] == []
    assert flight.published(COMMAND_RESULT)[-1].accepted


def test_it_is_over_when_the_vehicle_disarms():
    flight = flying().hear(2 * S, heartbeat(POSITION, armed=True)).hear(3 * S, heartbeat(POSITION))
    assert setpoints(flight, 3 * S) == 1
    flight.feed(VEHICLE_COMMAND, command("offboard", 3 * S))
    assert [m.param2 for m in flight.sent(codec.CommandLong)] == [6.0]


def test_our_own_landing_is_no_takeover():
    flight = flying().feed(VEHICLE_COMMAND, command("land", 2 * S))
    flight.hear(2 * S, heartbeat(OFFBOARD, armed=True), heartbeat(LAND, armed=True))
    flight.hear(9 * S, heartbeat(LAND), heartbeat(HOLD))
    assert texts(flight) == [] and refusals(flight) == [] and flight.published(WHY) == []


def test_the_autopilots_failsafe_is_a_takeover_too():
    flight = flying().hear(2 * S, heartbeat(4 << 16 | 5 << 24, armed=True))
    assert setpoints(flight, 2 * S) == 0


def test_a_heartbeat_that_was_overtaken_is_no_change_of_mode():
    flight = flying().feed(VEHICLE_COMMAND, command("land", 2 * S))
    flight.hear(3 * S, heartbeat(LAND, armed=True))
    flight.mav.seq = (flight.mav.seq - 20) & 0xFF
    flight.hear(3 * S + 80 * MS, heartbeat(OFFBOARD, armed=True))
    assert flight.tick(3 * S + 90 * MS).status.mode == "LAND" and texts(flight) == []


@pytest.mark.parametrize(
    "modes, taken",
    [
        (["HOLD", "HOLD", "OFFBOARD", "OFFBOARD"], False),  # it takes its time
        (["HOLD", "POSITION"], True),  # the pilot chose while we asked
        (["HOLD", "OFFBOARD", "HOLD"], True),  # he went back
    ],
)
def test_takeover_while_a_mode_is_on_its_way(modes, taken):
    authority = Authority()
    authority.asked("offboard", "HOLD")
    assert any([authority.saw(m, armed=True, now_ns=S) for m in modes]) is taken
    assert bool(authority.reason) is taken and authority.flying is not taken


def test_a_refused_mode_was_never_ours():
    authority = Authority()
    authority.asked("offboard", "HOLD")
    authority.refused("offboard")
    assert not authority.saw("POSITION", armed=True, now_ns=S) and not authority.flying


def test_a_takeover_on_the_ground_is_forgotten_after_a_while():
    authority = Authority()
    authority.asked("offboard", "HOLD")
    assert authority.saw("POSITION", armed=False, now_ns=S)
    authority.saw("POSITION", armed=False, now_ns=16 * S)
    assert authority.reason
    authority.saw("POSITION", armed=False, now_ns=17 * S)
    assert not authority.reason


# --- texts ------------------------------------------------------------------------------


@pytest.mark.parametrize("length, count", [(1, 1), (39, 1), (40, 2), (88, 2), (89, 3), (500, 5)])
def test_long_texts_go_in_pieces_that_a_ground_station_joins(length, count):
    text = ("abcdefghij" * 60)[:length]
    parts = pieces(News(Severity.WARNING, text), 7)
    assert len(parts) == count
    assert b"".join(p.text for p in parts).decode() == f"companion: {text}"[:200]
    assert [(p.id, p.chunk_seq) for p in parts] == ([(0, 0)] if count == 1 else [(7, k) for k in range(count)])
    assert len(parts[-1].text) < 50 or count == 1


def test_the_pilot_hears_of_guards_and_mission():
    flight = flying()

    def safety(action, reason=""):
        flight.feed(SAFETY, SafetyStatus(stamp_ns=S, action=action, speed_scale=1.0, reason=reason))

    def mission(state, reason=""):
        flight.feed(
            MISSION,
            MissionStatus(stamp_ns=S, step_id="a", step_index=0, step_count=1, state=state, reason=reason),
        )

    safety("ok"), safety("ok"), safety("slow", "few LiDAR points"), safety("slow", "few LiDAR points"), safety("ok")
    mission("running"), mission("running"), mission("failing", "battery 12% is below the reserve of 20%")
    assert texts(flight) == [
        "companion: safety slow: few LiDAR points",
        "companion: safety ok",
        "companion: mission running",
        "companion: mission failing: battery 12% is below the reserve of 20%",
    ]


def test_nobody_is_told_while_nobody_is_there():
    flight = Flight()
    flight.feed(SAFETY, SafetyStatus(stamp_ns=S, action="ok", speed_scale=1.0, reason=""))
    flight.feed(SAFETY, SafetyStatus(stamp_ns=S, action="land", speed_scale=0.0, reason="x"))
    assert flight.out == []


# --- a second companion -----------------------------------------------------------------


def other(now_ns, sequence, flight):
    encoder = codec.Encoder(system=1, component=191)
    encoder.sequence = sequence
    data = encoder.encode(codec.Heartbeat(0, 18, 8, 0, 4))
    return flight.feed(MAVLINK_RX, MavlinkBytes(stamp_ns=now_ns, data=data))


def test_beside_a_second_companion_nothing_is_commanded():
    flight = other(S, 77, ready_flight())
    reason = "another companion (1/191) speaks on this link"
    assert (flight.status.ready, flight.status.text) == (False, reason)
    assert [w.because for w in flight.published(WHY)] == [reason]
    assert texts(flight) == [f"companion: {reason}"]
    flight.feed(VEHICLE_COMMAND, command("offboard", S)).feed(VEHICLE_COMMAND, command("arm", S))
    assert flight.sent(codec.CommandLong) == [] and refusals(flight) == [("offboard", reason), ("arm", reason)]
    assert setpoints(flight, S) == 0
    other(2 * S, 78, flight)
    assert [w.what for w in flight.published(WHY)] == ["refuse to command", "send no setpoints"]  # said once
    later = 2 * S + 5 * S + 1
    flight.hear(later, heartbeat(), position()).feed(VEHICLE_COMMAND, command("arm", later))
    assert [m.command for m in flight.sent(codec.CommandLong)] == [400] and setpoints(flight, later) == 1


def test_in_flight_a_second_companion_is_told_of_and_the_flight_stays_ours():
    flight = other(2 * S, 77, flying())
    assert setpoints(flight, 2 * S) == 1
    for kind in ("offboard", "arm", "land"):
        flight.feed(VEHICLE_COMMAND, command(kind, 2 * S))
    assert [m.param3 for m in flight.sent(codec.CommandLong)] == [6.0]  # land
    assert [kind for kind, _ in refusals(flight)] == ["offboard", "arm"]


def test_our_own_heartbeat_sent_back_is_no_companion():
    flight = ready_flight()
    for i in range(25):
        flight.out.clear()
        flight.tick(S + i * 100 * MS)
        echo = b"".join(m.data for m in flight.published(MAVLINK_TX))
        flight.feed(MAVLINK_RX, MavlinkBytes(stamp_ns=S + i * 100 * MS, data=echo))
        assert flight.published(WHY) == [] and flight.status.text == ""


def test_it_listens_before_it_is_ready():
    flight = Flight().hear(S, heartbeat())
    full = ready_flight(4 * S)  # the same with everything heard
    assert not flight.tick(2 * S).status.ready and full.tick(4 * S).status.ready


# --- reboot -----------------------------------------------------------------------------


def at_boot_ms(boot_ms):
    return dialect.MAVLink_local_position_ned_message(boot_ms, 2.0, 1.0, -3.0, 0, 0, 0)


def answer(boot_ms, now_ns):
    return dialect.MAVLink_timesync_message(boot_ms * MS, now_ns)


@pytest.mark.parametrize("say", [lambda ms, now: at_boot_ms(ms), answer], ids=["position", "timesync"])
def test_a_reboot_in_flight_is_noticed_and_everything_starts_anew(say):
    flight = flying()
    for i in range(20):
        flight.hear(S + i * MS, say(90_000 + i, S + i * MS))
    flight.feed(VEHICLE_COMMAND, command("hold", 2 * S))
    flight.out.clear()
    flight.hear(3 * S, say(1_500, 3 * S))
    assert [w.because for w in flight.published(WHY)] == ["it rebooted: its clock went back"]
    assert refusals(flight) == [("hold", "the autopilot rebooted")]
    assert (flight.status.connected, flight.status.armed, flight.status.ready) == (False, False, False)
    flight.hear(3 * S + 500 * MS, heartbeat()).out.clear()
    assert flight.node._timesync.to_autopilot(3 * S) is None
    for i in range(60):
        now = 4 * S + i * 100 * MS
        flight.hear(now, heartbeat()).tick(now)
    assert {m.param1 for m in flight.sent(codec.CommandLong) if m.command == 511} == {32.0, 245.0, 1.0, 230.0}


@pytest.mark.parametrize(
    "times, reboots",
    [
        ([5000, 6000, 4500, 6100], 0),  # overtaken on the way
        ([5000, 6000, 3999], 1),
        ([2**32 - 10, 20, 30], 0),  # 49.7 days
        ([2**32 - 10, 20, 2**32 - 5, 30], 0),
        ([90_000, 100, 200], 1),
    ],
)
def test_what_counts_as_a_reboot(times, reboots):
    clock = BootClock()
    assert sum(clock.went_back(32, t) for t in times) == reboots


def test_positions_that_were_overtaken_are_dropped():
    flight = ready_flight().hear(S, at_boot_ms(5000))
    late = dialect.MAVLink_local_position_ned_message(4900, 9.0, 9.0, -9.0, 0, 0, 0)
    assert flight.hear(S, late).tick(S).status.p_odom[2] == pytest.approx(3.0)
