"""Signatures: ours against pymavlink's, both ways, and what frames that must not count change: nothing."""

from __future__ import annotations

from itertools import pairwise

import pytest
from pymavlink.dialects.v20 import all as dialect

from companion.autopilot import codec
from companion.autopilot.signing import EPOCH_NS, NEW_STREAM_UNITS, Signing, units
from companion.autopilot.wire import Parser
from companion.core.errors import InputError
from companion.core.messages import MavlinkBytes, VehicleCommand
from companion.core.topics import MAVLINK_RX, MAVLINK_TX, VEHICLE_COMMAND, WHY
from tests.unit.autopilot.flight_bench import MS, OFFBOARD, Flight, S, heartbeat

KEY, OTHER = bytes(range(32)), bytes(range(1, 33))
NOW = EPOCH_NS + 10**17
STAMP = units(NOW)


def theirs(key=KEY, *, timestamp=STAMP, link=0, system=1, component=1):
    """pymavlink with a key."""
    mav = dialect.MAVLink(None, srcSystem=system, srcComponent=component)
    mav.signing.secret_key, mav.signing.sign_outgoing = key, True
    mav.signing.timestamp, mav.signing.link_id = timestamp, link
    return mav


def frame(mav, message=None):
    return bytes((message or heartbeat()).pack(mav))


def heard(signing, *frames, now_ns=NOW):
    parser = Parser(signing=signing)
    return [len(parser.feed(f, now_ns)) for f in frames]


def test_what_pymavlink_signs_we_accept():
    signing, mav = Signing(KEY), theirs()
    assert heard(signing, *(frame(mav) for _ in range(50))) == [1] * 50
    assert signing.rejected.total == 0


def test_what_we_sign_pymavlink_accepts():
    encoder = codec.Encoder(system=1, component=191, signing=Signing(KEY, link_id=3))
    mav = theirs()
    for i in range(50):
        data = encoder.encode(codec.Timesync(tc1=0, ts1=i), NOW + i * MS)
        messages = mav.parse_buffer(data)
        assert [(m.get_type(), m.ts1, m.get_link_id()) for m in messages] == [("TIMESYNC", i, 3)]
    wrong = theirs(OTHER)
    with pytest.raises(dialect.MAVError, match="Invalid signature"):
        wrong.parse_buffer(encoder.encode(codec.Timesync(tc1=0, ts1=1), NOW + S))


def test_without_a_key_frames_are_pymavlinks_unsigned_ones():
    plain = dialect.MAVLink(None, srcSystem=1, srcComponent=191)
    ours = codec.Encoder(system=1, component=191).encode(codec.Heartbeat(6, 2, 12, 81, 4), NOW)
    assert ours == bytes(dialect.MAVLink_heartbeat_message(2, 12, 81, 6, 4, 3).pack(plain))


def test_unsigned_forged_replayed_and_altered_frames_do_not_count():
    signing, mav = Signing(KEY), theirs()
    good = frame(mav)
    plain, version_1 = dialect.MAVLink(None, srcSystem=1, srcComponent=1), bytes(heartbeat().pack(mav, True))
    altered = bytearray(frame(mav))
    altered[-1] ^= 1
    moved = bytearray(frame(mav))
    moved[-12] ^= 0x40  # another timestamp under the same hash
    assert heard(signing, good, good, frame(plain), version_1, frame(theirs(OTHER)), bytes(altered), bytes(moved)) == [
        1, 0, 0, 0, 0, 0, 0,
    ]  # fmt: skip
    r = signing.rejected
    assert (r.unsigned, r.forged, r.replayed) == (2, 3, 1)
    assert heard(signing, frame(mav)) == [1]


def test_a_frame_that_does_not_count_leaves_no_trace():
    """pymavlink notes the timestamp of a forged frame, so that anybody could silence a sender; we do not."""
    signing = Signing(KEY)
    assert heard(signing, frame(theirs(OTHER, timestamp=units(NOW) + 10**9)), frame(theirs())) == [0, 1]


@pytest.mark.parametrize("behind, counts", [(NEW_STREAM_UNITS, 1), (NEW_STREAM_UNITS + 1, 0)])
def test_a_new_stream_may_be_one_minute_behind(behind, counts):
    assert heard(Signing(KEY), frame(theirs(timestamp=units(NOW) - behind))) == [counts]


def test_streams_are_told_apart_by_system_component_and_link():
    signing, late = Signing(KEY), units(NOW) - 100
    senders = [{}, {"link": 1}, {"component": 2}, {"system": 2}]
    assert heard(signing, *(frame(theirs(timestamp=late, **s)) for s in senders)) == [1] * 4
    assert heard(signing, *(frame(theirs(timestamp=late, **s)) for s in senders)) == [0] * 4


def test_our_timestamps_rise_when_the_clock_steps_back_or_stands_before_2015():
    for times in ([NOW, NOW, NOW - 10**15, NOW + 1], [0, 0, 5, 10**9]):
        signing = Signing(KEY)
        stamps = [int.from_bytes(signing.signature(b"\xfd" * 12, t)[1:7], "little") for t in times]
        assert all(b > a for a, b in pairwise(stamps))


def test_a_clock_that_is_behind_learns_from_who_is_ahead():
    """As an autopilot without a clock does; afterwards what it heard before boot cannot be replayed."""
    signing, ahead = Signing(KEY), units(NOW)
    assert heard(signing, frame(theirs(timestamp=ahead)), now_ns=0) == [1]
    assert int.from_bytes(signing.signature(b"\xfd" * 12, 0)[1:7], "little") == ahead + 1
    assert heard(signing, frame(theirs(timestamp=ahead - NEW_STREAM_UNITS - 1, link=9)), now_ns=0) == [0]


def test_the_timestamp_stops_at_its_last_value():
    signing, last = Signing(KEY), (1 << 48) - 1
    assert heard(signing, frame(theirs(timestamp=last))) == [1]
    assert int.from_bytes(signing.signature(b"\xfd" * 12, NOW)[1:7], "little") == last


def test_a_key_of_another_length_is_refused():
    with pytest.raises(InputError, match="16 bytes"):
        Signing(bytes(16))


def test_the_node_signs_everything_and_hears_only_the_key():
    flight = Flight(key=KEY)
    for mav in (dialect.MAVLink(None, 1, 1), theirs(OTHER)):
        flight.feed(MAVLINK_RX, MavlinkBytes(stamp_ns=NOW, data=frame(mav, heartbeat(OFFBOARD, armed=True))))
    assert not flight.tick(NOW).status.connected and not flight.status.armed
    mav = theirs()
    signed = frame(mav, heartbeat(OFFBOARD, armed=True))
    flight.feed(MAVLINK_RX, MavlinkBytes(stamp_ns=NOW, data=signed))
    assert flight.status.connected and flight.status.armed
    flight.feed(MAVLINK_RX, MavlinkBytes(stamp_ns=NOW + S, data=frame(mav, heartbeat())))
    flight.feed(MAVLINK_RX, MavlinkBytes(stamp_ns=NOW + 2 * S, data=signed))  # replayed
    assert not flight.status.armed
    flight.feed(VEHICLE_COMMAND, VehicleCommand(stamp_ns=NOW, kind="arm"))
    checker = theirs()
    out = b"".join(m.data for m in flight.published(MAVLINK_TX))
    assert {m.get_type() for m in checker.parse_buffer(out)} == {"HEARTBEAT", "COMMAND_LONG"}
    for i in range(101):
        flight.tick(NOW + 2 * S + i * 100 * MS)
    early, late = (w.because for w in flight.published(WHY) if "signature" in w.what)
    assert early == "1 unsigned, 1 of another key or altered, 0 replayed or too old so far"
    assert late == "1 unsigned, 1 of another key or altered, 1 replayed or too old so far"


def status_after(flight, *frames, now_ns=NOW):
    for data in frames:
        flight.feed(MAVLINK_RX, MavlinkBytes(stamp_ns=now_ns, data=data))
    return flight.tick(now_ns + 100 * MS).status


def test_the_status_says_that_keys_keep_both_sides_apart():
    other = status_after(Flight(key=KEY), frame(theirs(OTHER)))
    assert not other.connected and "both sides need the same key file" in other.text
    unsigned = status_after(Flight(key=KEY), frame(dialect.MAVLink(None, srcSystem=1, srcComponent=1)))
    assert not unsigned.connected and "both sides need the same key file" in unsigned.text
    without = status_after(Flight(), frame(theirs()))
    assert without.connected and not without.ready and "it may want ours signed" in without.text
    same = status_after(Flight(key=KEY), frame(theirs()))
    assert same.connected and same.text == ""


def test_what_a_silent_vehicle_said_is_not_repeated():
    flight = Flight()
    said = dialect.MAVLink_statustext_message(6, b"Takeoff detected")
    assert status_after(flight, *(frame(theirs(), m) for m in (heartbeat(), said))).text.startswith("Takeoff detected")
    assert status_after(flight, now_ns=NOW + 10 * S).connected is False
    assert flight.status.text == ""
