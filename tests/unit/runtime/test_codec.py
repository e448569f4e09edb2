"""The digest of a message is the digest of its bytes, whatever is in it."""

import numpy as np
import pytest
from xxhash import xxh3_128_digest

from companion.core.messages import CameraImage, Goal, Limits, LocalMap, MavlinkBytes, RangeReading
from companion.runtime.codec import decode, digest, encode, summed

LIMITS = Limits(
    speed=2.0, climb=1.0, accel=2.0, jerk=10.0, yaw_rate=1.0, clearance=0.5, unknown="blocked", agl_min=0.5, agl_max=9.0
)
RNG = np.random.default_rng(1)


def local_map(*shape: int) -> LocalMap:
    return LocalMap(
        stamp_ns=5,
        origin_odom=np.zeros(3),
        resolution_m=0.2,
        state=RNG.integers(0, 3, shape, np.uint8),
        distance_m=RNG.random(shape, np.float32),
        unknown_distance_m=RNG.random(shape[::-1], np.float32).T,  # not contiguous
        ground_z_odom=np.full(shape[:2], np.nan, np.float32),
    )


MESSAGES = {
    "numbers": RangeReading(stamp_ns=2**62, range_m=float("nan")),
    "numpy number": RangeReading(stamp_ns=1, range_m=np.float64(0.25)),
    "bytes": MavlinkBytes(stamp_ns=1, data=bytes(70_000)),
    "nested": Goal(
        stamp_ns=1, id=2, kind="fly", p_odom=np.ones(3), agl_m=1.0, radius_m=0.5, fly_through=True,
        next_p_odom=np.empty((0, 3)), yaw=0.0, if_blocked="fail", limits=LIMITS,
    ),
    "small arrays": local_map(4, 5, 6),
    "large arrays": local_map(64, 65, 66),
    **{f"image of {n}": CameraImage(stamp_ns=1, pixels=np.zeros((1, n), np.uint8)) for n in (65_535, 65_536, 65_537)},
}  # fmt: skip


@pytest.mark.parametrize("name", MESSAGES)
def test_the_digest_is_that_of_the_bytes(name):
    data = encode(MESSAGES[name])
    assert digest(MESSAGES[name]) == (xxh3_128_digest(data), len(data))
    assert summed(MESSAGES[name], stored=True) == (data, xxh3_128_digest(data), len(data))
    assert summed(MESSAGES[name], stored=False) == (None, xxh3_128_digest(data), len(data))
    assert encode(decode(data, type(MESSAGES[name]))) == data


def test_one_changed_bit_of_an_array_changes_the_digest():
    before = local_map(64, 65, 66)
    changed = before.state.copy()
    changed[30, 30, 30] ^= 1
    parts = {slot: getattr(before, slot) for slot in before.__slots__}
    assert digest(LocalMap(**{**parts, "state": changed}))[0] != digest(before)[0]
