"""Framing: chunks, damage, signatures, unknown ids."""

from __future__ import annotations

import gzip
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import all as dialect

from companion.autopilot.codec import Encoder, Heartbeat, LocalPositionNed, Timesync, decode
from companion.autopilot.inspect import Record, read_tlog
from companion.autopilot.wire import CRC_EXTRA, PX4_ONLY, Parser

PX4_LOG = Path(__file__).parents[4] / "shared/data/log_mavlink_tlog/px4_offboard_both_directions.tlog.gz"


def stream(count: int = 40) -> tuple[bytes, int]:
    """Frames of three kinds with noise between some of them."""
    encoder = Encoder(system=1, component=1)
    rng = np.random.default_rng(3)
    data = b""
    for i in range(count):
        message = (
            Heartbeat(i, 2, 12, 81, 4),
            LocalPositionNed(i, *rng.normal(size=6).tolist()),
            Timesync(0, int(rng.integers(1 << 62))),
        )[i % 3]
        data += encoder.encode(message)
        if i % 5 == 0:
            data += rng.bytes(int(rng.integers(1, 30)))
    return data + encoder.encode(Heartbeat(99, 2, 12, 81, 4)) + b"\0" * 300, count + 1


def counters(parser: Parser) -> tuple[int, ...]:
    return (
        parser.frames,
        parser.unknown,
        parser.signed,
        parser.corrupt_pieces,
        parser.skipped_bytes,
    )


@settings(max_examples=150, deadline=None)
@given(st.lists(st.integers(1, 70), min_size=1, max_size=20))
def test_any_cut_gives_the_same_messages(sizes):
    data, count = stream()
    whole, cut = Parser(), Parser()
    expected = whole.feed(data)
    found, at, i = [], 0, 0
    while at < len(data):
        size = sizes[i % len(sizes)]
        found += cut.feed(data[at : at + size])
        at, i = at + size, i + 1
    assert found == expected
    assert counters(cut) == counters(whole)
    assert len(expected) == count


@settings(max_examples=200, deadline=None)
@given(st.binary(max_size=600), st.integers(0, 600))
def test_noise_never_raises_and_cuts_do_not_matter(data, cut):
    whole, parts = Parser(), Parser()
    expected = whole.feed(data)
    assert parts.feed(data[:cut]) + parts.feed(data[cut:]) == expected
    assert counters(parts) == counters(whole)
    for frame in expected:
        decode(frame)


def test_mutated_frames_never_raise_and_seldom_pass():
    """50,000 frames with 1-4 bytes changed: a 16-bit CRC lets about 1 in 65,536 through."""
    rng = np.random.default_rng(1)
    encoder = Encoder(system=1, component=1)
    parser = Parser()
    passed = 0
    for i in range(50_000):
        frame = bytearray(encoder.encode(LocalPositionNed(i, 1.5, -2.5, 3.5, 0.1, 0.2, 0.3)))
        original = bytes(frame)
        for at in rng.integers(0, len(frame), size=int(rng.integers(1, 5))):
            frame[at] = int(rng.integers(256))
        if bytes(frame) == original:
            continue
        for found in parser.feed(bytes(frame)):
            decode(found)
            passed += found.known
    assert parser.frames < 100  # unknown ids pass 1 in 256 of the time
    assert passed <= 5


def test_each_damaged_frame_costs_only_itself():
    encoder = Encoder(system=1, component=1)
    good = [encoder.encode(Heartbeat(i, 2, 12, 81, 4)) for i in range(20)]
    damaged = [bytearray(f) for f in good]
    for i in (3, 7, 8, 15):
        damaged[i][12] ^= 0x55
    parser = Parser()
    kept = [decode(f).custom_mode for f in parser.feed(b"".join(damaged))]
    assert kept == [i for i in range(20) if i not in (3, 7, 8, 15)]
    assert parser.corrupt_pieces == 3  # 7 and 8 are one run


def test_filter_counts_what_it_does_not_return():
    data, count = stream()
    parser = Parser({111})
    assert {f.msg_id for f in parser.feed(data)} == {111}
    assert parser.frames == count


def test_signed_frames_are_read_and_flagged():
    mav = dialect.MAVLink(None, srcSystem=1, srcComponent=1)
    mav.signing.secret_key = bytes(range(32))
    mav.signing.sign_outgoing = True
    mav.signing.timestamp = 1
    signed = dialect.MAVLink_heartbeat_message(2, 12, 81, 5, 4, 3).pack(mav)
    plain = Encoder(system=1, component=1).encode(Heartbeat(6, 2, 12, 81, 4))
    parser = Parser()
    frames = parser.feed(bytes(signed) + plain)
    assert [(f.signed, decode(f).custom_mode) for f in frames] == [(True, 5), (False, 6)]
    assert parser.signed == 1 and parser.corrupt_pieces == 0


def test_unsupported_incompatible_flags_are_dropped():
    frame = bytearray(Encoder(system=1, component=1).encode(Heartbeat(6, 2, 12, 81, 4)))
    frame[2] = 0x02
    parser = Parser()
    assert parser.feed(bytes(frame) + bytes(300)) == []
    assert parser.skipped_bytes == len(frame) + 300


def test_an_unknown_id_is_stepped_over_whole():
    """The CRC seed of an id that nobody defined cannot be checked, but some seed must fit."""
    unknown_id = 15_999
    assert unknown_id not in CRC_EXTRA
    encoder = Encoder(system=1, component=1)
    known = encoder.encode(Heartbeat(6, 2, 12, 81, 4))
    from fastcrc.crc16 import mcrf4xx

    payload = b"\xfd\xfe" * 100  # full of bytes that look like a start
    body = bytes([len(payload), 0, 0, 9, 1, 1]) + unknown_id.to_bytes(3, "little") + payload
    frame = b"\xfd" + body + mcrf4xx(body + b"\x2a").to_bytes(2, "little")
    parser = Parser()
    frames = parser.feed(known + frame + known)
    assert [f.name for f in frames] == ["HEARTBEAT", "UNKNOWN_15999", "HEARTBEAT"]
    assert [f.known for f in frames] == [True, False, True]
    assert decode(frames[1]) is None
    assert parser.corrupt_pieces == 0


@pytest.mark.skipif(not PX4_LOG.exists(), reason="recorded logs are not here")
def test_our_extra_definitions_fit_recorded_px4_traffic():
    data = gzip.decompress(PX4_LOG.read_bytes())
    records = [r for r in read_tlog(data) if isinstance(r, Record)]
    seen = {r.frame.msg_id for r in records if r.frame.known}
    assert set(PX4_ONLY) <= seen
    assert len(records) == 76_225
