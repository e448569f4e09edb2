"""The autopilot's signatures against pymavlink's, and the autopilot with a key: nobody else moves it."""

from __future__ import annotations

import pytest
from pymavlink.dialects.v20 import all as dialect

from companion.autopilot.node import AutopilotConfig as CompanionConfig
from companion.autopilot.node import AutopilotNode
from companion.core.messages import MavlinkBytes, VehicleCommand
from companion.core.topics import COMMAND_RESULT, MAVLINK_RX, MAVLINK_TX, VEHICLE, VEHICLE_COMMAND
from sim.autopilot.autopilot import Autopilot
from sim.autopilot.codec import BY_NAME, Encoder, Parser
from sim.autopilot.readings import AutopilotConfig
from sim.autopilot.signing import MINUTE, START_NS, TOP, Signing
from tests.unit.sim_autopilot.conftest import airframe

KEY, OTHER = bytes(range(32)), bytes(32)
NOW = START_NS + 10**17
STAMP = 10**13
PING = dialect.MAVLink_ping_message(1, 2, 0, 0)
SECOND = 10**9


def theirs(key=KEY, *, timestamp=STAMP, link=0, component=191):
    mav = dialect.MAVLink(None, srcSystem=1, srcComponent=component)
    mav.signing.secret_key, mav.signing.sign_outgoing = key, True
    mav.signing.timestamp, mav.signing.link_id = timestamp, link
    return mav


def signing_at(now_ns=NOW):
    signing = Signing(KEY)
    signing.now_ns = now_ns
    return signing


def counted(signing, *frames):
    parser = Parser(signing=signing)
    return [len(parser.feed(f)) for f in frames]


def test_pymavlink_signs_and_the_autopilot_hears():
    mav = theirs()
    assert counted(signing_at(), *(bytes(PING.pack(mav)) for _ in range(20))) == [1] * 20


def test_the_autopilot_signs_and_pymavlink_hears():
    encoder, mav = Encoder(system=1, component=1, signing=signing_at()), theirs()
    for i in range(20):
        (m,) = mav.parse_buffer(encoder(BY_NAME["PING"], i, 2, 0, 0))
        assert m.get_type() == "PING" and m.time_usec == i and m.get_signed()


def test_unsigned_forged_and_replayed_frames_count_as_not_come():
    signing, mav = signing_at(), theirs()
    good = bytes(PING.pack(mav))
    plain = bytes(PING.pack(dialect.MAVLink(None, 1, 191)))
    assert counted(signing, good, good, plain, bytes(PING.pack(theirs(OTHER)))) == [1, 0, 0, 0]
    assert signing.dropped == {"unsigned": 1, "forged": 1, "replayed": 1}


@pytest.mark.parametrize("behind, counts", [(MINUTE, 1), (MINUTE + 1, 0)])
def test_a_new_sender_may_be_a_minute_behind(behind, counts):
    assert counted(signing_at(), bytes(PING.pack(theirs(timestamp=STAMP - behind)))) == [counts]


def test_timestamps_rise_whatever_the_clock_does_and_stop_at_the_top():
    signing, stamps = signing_at(), []
    for signing.now_ns in (NOW, NOW, 0, NOW + 1):
        stamps.append(int.from_bytes(signing.tail(b"\xfd" * 12)[1:7], "little"))
    assert stamps == sorted(set(stamps))
    assert counted(signing, bytes(PING.pack(theirs(timestamp=TOP)))) == [1]
    assert int.from_bytes(signing.tail(b"\xfd" * 12)[1:7], "little") == TOP


def autopilot(key):
    return Autopilot(AutopilotConfig(), airframe=airframe(), seed=1, signing_key=key)


def arm_by_force(mav):
    return bytes(dialect.MAVLink_command_long_message(1, 1, 400, 0, 1, 21196, 0, 0, 0, 0, 0).pack(mav))


def test_an_autopilot_with_a_key_is_moved_by_its_holder_only():
    """Its clock stands at 1970: it signs all the same, and takes the time over from who has the key."""
    vehicle = autopilot(KEY)
    quiet = vehicle.transmit(0)
    assert all(m.get_signed() for m in theirs(timestamp=0).parse_buffer(quiet))
    signed = arm_by_force(theirs())
    for data in (arm_by_force(dialect.MAVLink(None, 1, 191)), arm_by_force(theirs(OTHER)), signed[:-1] + b"\0"):
        vehicle.receive(SECOND, data)
        assert not vehicle.armed
    assert b"COMMAND_ACK" not in _names(vehicle.transmit(SECOND))
    vehicle.receive(2 * SECOND, signed)
    assert vehicle.armed
    answers = theirs().parse_buffer(vehicle.transmit(2 * SECOND))
    assert "COMMAND_ACK" in {m.get_type() for m in answers} and all(m.get_signed() for m in answers)
    vehicle.commander.disarm(force=True)
    vehicle.receive(3 * SECOND, signed)
    assert not vehicle.armed and vehicle.signing.dropped["replayed"] == 1


def _names(data):
    return {m.get_type().encode() for m in dialect.MAVLink(None).parse_buffer(data) or []}


def test_without_a_key_the_bytes_are_as_they_were():
    keyed, plain = autopilot(KEY), autopilot(None)
    signed, bare = keyed.transmit(SECOND), plain.transmit(SECOND)
    frames = dialect.MAVLink(None).parse_buffer(bare)
    assert not any(m.get_signed() for m in frames)
    assert len(signed) == len(bare) + 13 * len(frames)


@pytest.mark.parametrize(
    "key, connected, reason",
    [
        (KEY, True, "temporarily rejected"),  # it heard, and does not want to: nothing is known of its attitude
        (OTHER, False, "timeout"),
        (None, True, "timeout; the autopilot signs its messages: it may want ours signed, with its key"),
    ],
)
def test_companion_and_autopilot_with_the_same_another_and_no_key(key, connected, reason):
    node, vehicle = AutopilotNode(CompanionConfig(), signing_key=key), autopilot(KEY)
    status = result = None
    for i in range(80):
        now = NOW + i * 100_000_000  # ours is the right time, the autopilot's starts at its boot
        out = list(node.tick("step", now))
        if i == 50:
            out += node.handle(VEHICLE_COMMAND, VehicleCommand(stamp_ns=now, kind="arm"))
        for o in out:
            if o.topic is MAVLINK_TX:
                vehicle.receive(i * 100_000_000, o.message.data)
        rx = MavlinkBytes(stamp_ns=now, data=vehicle.transmit(i * 100_000_000))
        for o in [*out, *node.handle(MAVLINK_RX, rx)]:
            status = o.message if o.topic is VEHICLE else status
            result = o.message if o.topic is COMMAND_RESULT else result
    assert (status.connected, result.accepted, result.reason) == (connected, False, reason)
