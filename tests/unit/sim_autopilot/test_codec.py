"""Our bytes are pymavlink's bytes; damage costs frames, never an exception."""

import itertools
import math
import struct

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import all as dialect

from sim.autopilot.codec import BY_NAME, LAYOUTS, Encoder, Parser

HOT = [
    "ATTITUDE", "ATTITUDE_QUATERNION", "HIGHRES_IMU", "LOCAL_POSITION_NED", "ODOMETRY", "TIMESYNC",
    "SET_POSITION_TARGET_LOCAL_NED", "COMMAND_LONG", "STATUSTEXT", "PARAM_VALUE", "AUTOPILOT_VERSION",
    "BATTERY_STATUS", "CURRENT_MODE", "MISSION_ITEM_INT",
]  # fmt: skip
RANGES = {"B": (0, 255), "b": (-128, 127), "H": (0, 65535), "h": (-32768, 32767), "I": (0, 2**32 - 1),
          "i": (-(2**31), 2**31 - 1), "Q": (0, 2**64 - 1), "q": (-(2**63), 2**63 - 1)}  # fmt: skip


def flat_values(layout):
    """A strategy of values that fit the flat layout."""
    parts, number = [], ""
    for letter in layout.packer.format[1:]:
        if letter.isdigit():
            number += letter
        elif letter == "s":
            parts.append(st.binary(max_size=int(number)).map(lambda b: b.replace(b"\0", b"x")))
            number = ""
        else:
            kind = st.floats(width=32, allow_nan=False) if letter == "f" else st.integers(*RANGES[letter])
            parts += [kind] * int(number or 1)
            number = ""
    return st.tuples(*parts)


def by_pymavlink(layout, values, *, system=1, component=1):
    """The same message packed by pymavlink's own class."""
    named = layout.unflatten(tuple(values))
    cls = dialect.mavlink_map[layout.msg_id]
    for field, kind in zip(cls.fieldnames, cls.fieldtypes, strict=True):
        if kind == "char":
            named[field] = named[field] if isinstance(named[field], bytes) else bytes(named[field])
    mav = dialect.MAVLink(None, srcSystem=system, srcComponent=component)
    return cls(**{f: list(v) if isinstance(v, tuple) else v for f, v in named.items()}).pack(mav)


@pytest.mark.parametrize("name", HOT)
@settings(max_examples=20, deadline=None)
@given(data=st.data())
def test_frames_equal_pymavlinks(name, data):
    layout = BY_NAME[name]
    values = data.draw(flat_values(layout))
    ours = Encoder(system=1, component=1)(layout, *values)
    assert ours == by_pymavlink(layout, values)
    frame = Parser().feed(ours)[0]
    assert (frame.layout, frame.system, frame.component) == (layout, 1, 1)
    expected = layout.packer.unpack(layout.packer.pack(*values))
    assert frame.values == expected


def test_every_layout_has_as_many_values_as_its_format():
    for layout in LAYOUTS.values():
        assert len(layout.packer.unpack(bytes(layout.packer.size))) == sum(layout.lengths), layout.name


def test_the_sequence_counts_and_wraps():
    encoder = Encoder(system=1, component=1)
    sequence = [encoder(BY_NAME["TIMESYNC"], 0, 1)[4] for _ in range(257)]
    assert sequence == [*range(256), 0]


def stream(count=30):
    rng = np.random.default_rng(3)
    encoder = Encoder(system=1, component=191)
    return [
        encoder(BY_NAME["SET_POSITION_TARGET_LOCAL_NED"], k, *rng.normal(0, 1, 11), 0, 1, 1, 1) for k in range(count)
    ]


@given(cuts=st.lists(st.integers(0, 1500), max_size=20))
@settings(max_examples=30, deadline=None)
def test_frames_do_not_depend_on_where_the_stream_is_cut(cuts):
    data = b"".join(stream())
    parser, edges = Parser(), [0, *sorted(min(c, len(data)) for c in cuts), len(data)]
    found = [f for a, b in itertools.pairwise(edges) for f in parser.feed(data[a:b])]
    assert [f.values[0] for f in found] == list(range(30))


def test_noise_between_frames_loses_none_of_them():
    rng = np.random.default_rng(1)
    noise = [bytes(b for b in rng.integers(0, 256, 20, np.uint8).tobytes() if b not in (0xFD, 0xFE)) for _ in range(30)]
    data = b"".join(n + f for n, f in zip(noise, stream(), strict=True))
    parser = Parser()
    assert [f.values[0] for f in parser.feed(data)] == list(range(30))
    assert parser.damaged > 0


def test_a_flipped_bit_is_never_a_frame():
    whole = stream(1)[0]
    for bit in range(8 * len(whole)):
        damaged = bytearray(whole)
        damaged[bit // 8] ^= 1 << bit % 8
        frames = Parser().feed(bytes(damaged) + bytes(300))
        # Only the compatibility flags and a magic that starts nothing may change without harm: they cannot.
        assert frames == [], bit


def test_version_1_frames_and_signed_frames_are_read():
    from pymavlink.dialects.v10 import common as v10

    old = v10.MAVLink(None, srcSystem=7, srcComponent=8)
    data = v10.MAVLink_heartbeat_message(6, 8, 0, 5, 4, 3).pack(old)
    frame = Parser().feed(data)[0]
    assert frame.named == {"custom_mode": 5, "type": 6, "autopilot": 8, "base_mode": 0, "system_status": 4,
                           "mavlink_version": 3}  # fmt: skip
    signer = dialect.MAVLink(None, srcSystem=1, srcComponent=2)
    signer.signing.secret_key, signer.signing.sign_outgoing = bytes(32), True
    signed = dialect.MAVLink_timesync_message(1, 2).pack(signer)
    assert Parser().feed(signed)[0].values == (1, 2)


def test_a_value_that_does_not_fit_is_refused():
    with pytest.raises(struct.error):
        Encoder(system=1, component=1)(BY_NAME["PING"], 1, 2, 256, 0)


def test_nan_passes():
    frame = Parser().feed(Encoder(system=1, component=1)(BY_NAME["ATTITUDE"], 1, math.nan, *[0.0] * 5))[0]
    assert math.isnan(frame.values[1])
