"""Our payloads against pymavlink's, byte for byte."""

from __future__ import annotations

import math

import numpy as np
import pytest
from pymavlink.dialects.v20 import all as dialect

from companion.autopilot import codec
from companion.autopilot.codec import Encoder, decode
from companion.autopilot.wire import Parser

HOT = [
    (codec.Heartbeat, dialect.MAVLink_heartbeat_message),
    (codec.AttitudeQuaternion, dialect.MAVLink_attitude_quaternion_message),
    (codec.LocalPositionNed, dialect.MAVLink_local_position_ned_message),
    (codec.CommandLong, dialect.MAVLink_command_long_message),
    (codec.SetPositionTarget, dialect.MAVLink_set_position_target_local_ned_message),
    (codec.HighresImu, dialect.MAVLink_highres_imu_message),
    (codec.Timesync, dialect.MAVLink_timesync_message),
    (codec.Odometry, dialect.MAVLink_odometry_message),
]
RANGES = {
    "uint8_t": (0, 255),
    "int8_t": (-128, 127),
    "uint16_t": (0, 65535),
    "int16_t": (-32768, 32767),
    "uint32_t": (0, 2**32 - 1),
    "int32_t": (-(2**31), 2**31 - 1),
    "uint64_t": (0, 2**63 - 1),
    "int64_t": (-(2**62), 2**62),
}


def random_value(kind: str, rng: np.random.Generator):
    if kind in ("float", "double"):
        return float(np.float32(rng.normal(scale=100)))
    low, high = RANGES[kind]
    return int(rng.integers(low, high, endpoint=True))


def random_fields(message, rng: np.random.Generator) -> dict:
    """Field name -> random value (list for arrays, bytes for strings)."""
    fields = {}
    lengths = dict(zip(message.ordered_fieldnames, message.array_lengths, strict=True))
    kinds = dict(zip(message.fieldnames, message.fieldtypes, strict=True))
    for name in message.fieldnames:
        if kinds[name] == "char":
            size = int(rng.integers(0, max(lengths[name], 1) + 1))
            fields[name] = bytes(rng.integers(97, 123, size=size, dtype=np.uint8))
        elif lengths[name]:
            fields[name] = [random_value(kinds[name], rng) for _ in range(lengths[name])]
        else:
            fields[name] = random_value(kinds[name], rng)
    return fields


def same(a, b) -> bool:
    if isinstance(a, (list, tuple)):
        return len(a) == len(b) and all(map(same, a, b))
    if isinstance(a, float) and math.isnan(a):
        return math.isnan(b)
    return a == b


@pytest.mark.parametrize(("ours", "theirs"), HOT, ids=[o.__name__ for o, _ in HOT])
def test_hot_frames_equal_pymavlinks(ours, theirs):
    rng = np.random.default_rng(7)
    encoder = Encoder(system=42, component=191)
    mav = dialect.MAVLink(None, srcSystem=42, srcComponent=191)
    for _ in range(300):  # also past the wrap of the sequence number
        fields = random_fields(theirs, rng)
        expected = theirs(**fields).pack(mav)
        mav.seq = (mav.seq + 1) % 256
        message = ours(**{k: tuple(v) if isinstance(v, list) else v for k, v in fields.items()})
        assert encoder.encode(message) == bytes(expected)
        (frame,) = Parser().feed(bytes(expected))
        assert decode(frame) == message


@pytest.mark.parametrize(("ours", "theirs"), HOT, ids=[o.__name__ for o, _ in HOT])
def test_hot_zeros_and_nan_survive_the_cut_of_trailing_zeros(ours, theirs):
    rng = np.random.default_rng(8)
    zeros = {k: [0] * len(v) if isinstance(v, list) else 0 for k, v in random_fields(theirs, rng).items()}
    mav = dialect.MAVLink(None, srcSystem=1, srcComponent=1)
    message = ours(**{k: tuple(v) if isinstance(v, list) else v for k, v in zeros.items()})
    frame = Encoder(system=1, component=1).encode(message)
    assert frame == bytes(theirs(**zeros).pack(mav))
    (read,) = Parser().feed(frame)
    assert decode(read) == message
    first_float = next((k for k, v in message._asdict().items() if isinstance(v, float)), None)
    assert first_float is None or math.isnan(
        getattr(
            decode(
                Parser().feed(Encoder(system=1, component=1).encode(message._replace(**{first_float: math.nan})))[0]
            ),
            first_float,
        )
    )


def random_kinds(count: int) -> list:
    rng = np.random.default_rng(30)
    hot = {theirs.id for _, theirs in HOT}
    ids = [i for i in sorted(dialect.mavlink_map) if i not in hot and i >= 0]
    return [dialect.mavlink_map[i] for i in rng.choice(ids, size=count, replace=False)]


KINDS = [(kind, v) for kind in random_kinds(40) for v in (1, 2) if v == 2 or kind.id < 256]


@pytest.mark.parametrize(("kind", "version"), KINDS, ids=lambda k: getattr(k, "msgname", f"v{k}"))
def test_other_messages_decode_as_pymavlink_does(kind, version):
    rng = np.random.default_rng(kind.id)
    for _ in range(10):
        mav = dialect.MAVLink(None, srcSystem=1, srcComponent=1)
        frame = bytes(kind(**random_fields(kind, rng)).pack(mav, force_mavlink1=version == 1))
        expected = dialect.MAVLink(None).decode(bytearray(frame)).to_dict()
        (read,) = Parser().feed(frame)
        found = decode(read).to_dict()
        assert found.keys() == expected.keys()
        assert all(same(found[k], expected[k]) for k in expected)


def test_strings_lose_their_padding():
    mav = dialect.MAVLink(None, srcSystem=1, srcComponent=1)
    frame = dialect.MAVLink_statustext_message(4, b"Takeoff detected").pack(mav)
    (read,) = Parser().feed(bytes(frame))
    assert decode(read).text == "Takeoff detected"


def test_any_payload_of_any_message_decodes():
    """Right CRC, senseless content: 20 random payloads of random length for each id."""
    rng = np.random.default_rng(11)
    encoder, parser = Encoder(system=1, component=1), Parser()
    ids = [i for i in sorted(dialect.mavlink_map) if i >= 0]
    for msg_id in ids:
        for _ in range(20):
            (frame,) = parser.feed(encoder.frame(msg_id, rng.bytes(int(rng.integers(1, 256)))))
            assert frame.msg_id == msg_id
            assert decode(frame) is not None
