"""A region of 8 x 8 x 4 blocks put away as bytes, and back without loss."""

from __future__ import annotations

import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from companion.mapping.cell_coder import decode, encode
from companion.mapping.marks import KINDS, QUIET, STILL
from companion.mapping.rays import WORDS

i64 = np.int64
SHAPE = np.array([8, 8, 4])  # blocks of a region
PLACES = int(SHAPE.prod())
_X, _Y, _Z = 3, 3, 2  # shifts from a block's position to its region's
_SHIFT = np.array([_X, _Y, _Z])
_HALF_RANGE = 1 << 20  # regions either way
_AXIS = (1 << 21) - 1
_OVERHEAD = 520  # bytes of the objects around the bytes, and of the tables that name them
_REST = (("changed_at", "<i8"), ("seen_ns", "<i8"), ("held", "|u1"), ("stirred", "|u1"))
Blocks = dict[str, NDArray[Any]]  # as `BlockStore.take` gives them


@dataclass(frozen=True, slots=True)
class ColdRegion:
    """Blocks of one region, in order of their places."""

    count: int
    changes: tuple[int, int]  # smallest and largest `changed_at` inside
    seen_ns: tuple[int, int]  # and `seen_ns`
    held: bool  # a block of a loaded map is inside
    places: bytes  # a bit for each of the PLACES
    sizes: tuple[int, int]  # bytes of the log-odds, of the rest; what follows are the marks
    size: int  # of all of them
    data: bytes  # empty: they lie on a shelf

    @property
    def memory_bytes(self) -> int:
        """Bytes of memory, estimated, as if nothing lay on a shelf: the bytes and the objects around them."""
        return len(self.places) + self.size + _OVERHEAD


def pack(blocks: Mapping[str, NDArray[Any]]) -> ColdRegion:
    """Compress blocks of one region, in order of their places."""
    there = np.zeros(PLACES, np.uint8)
    there[places_of(blocks["xyz"])] = 1
    # Bytes of equal weight side by side: most of a stamp is the same all over the region.
    planes = [blocks[name].view(np.uint8).reshape(len(blocks[name]), -1).T.tobytes() for name, _ in _REST]
    log_odds = encode(places_of(blocks["xyz"]), blocks["log_odds"])
    rest = zlib.compress(b"".join(planes), 1)
    data = b"".join([log_odds, rest, _packed_marks(blocks)])
    return ColdRegion(
        count=len(blocks["xyz"]),
        changes=(int(blocks["changed_at"].min()), int(blocks["changed_at"].max())),
        seen_ns=(int(blocks["seen_ns"].min()), int(blocks["seen_ns"].max())),
        held=bool(blocks["held"].any()),
        places=np.packbits(there).tobytes(),
        sizes=(len(log_odds), len(rest)),
        size=len(data),
        data=data,
    )


def unpack(region: ColdRegion, key: int) -> Blocks:
    """The blocks that `pack` was given; `key` is the region's."""
    xyz = xyz_of(region, key)
    blocks: Blocks = {"xyz": xyz, "log_odds": decode(region.data[: region.sizes[0]], places_of(xyz))}
    blocks |= unpack_rest(region)
    blocks["marks"] = _marks(region.data[sum(region.sizes) :], blocks["log_odds"])
    return blocks


def xyz_of(region: ColdRegion, key: int) -> NDArray[np.int32]:
    """Positions (N, 3) of its blocks."""
    return blocks_at(region.places, key)


def blocks_at(places: bytes, key: int) -> NDArray[np.int32]:
    """Positions (N, 3) of blocks, by the bits of their places in the region."""
    return np.asarray(_corner(key) + _PLACE_XYZ[np.unpackbits(np.frombuffer(places, np.uint8)) != 0], np.int32)


def unpack_rest(region: ColdRegion) -> Blocks:
    """The arrays of one number per block."""
    first, last = region.sizes[0], sum(region.sizes)
    data, first = np.frombuffer(zlib.decompress(region.data[first:last]), np.uint8), 0
    blocks: Blocks = {}
    for name, kind in _REST:
        size = np.dtype(kind).itemsize
        planes = data[first : first + size * region.count].reshape(size, region.count)
        blocks[name] = np.ascontiguousarray(planes.T).view(kind).reshape(region.count)
        first += size * region.count
    return blocks


def _packed_marks(blocks: Mapping[str, NDArray[Any]]) -> bytes:
    """Marks of the blocks that have some; where nothing happens, all that is occupied is quiet and still."""
    marks: NDArray[np.uint64] = blocks["marks"]
    some = np.flatnonzero(marks.any(axis=(1, 2)))
    if len(some) == 0:
        return b""
    odd = marks[some]
    odd[:, [QUIET, STILL]] ^= _occupied(blocks["log_odds"][some])[:, None]
    bits = np.zeros(len(marks), np.uint8)
    bits[some] = 1
    return zlib.compress(np.packbits(bits).tobytes() + odd.transpose(1, 0, 2).tobytes(), 1)


def _marks(data: bytes, log_odds: NDArray[np.int8]) -> NDArray[np.uint64]:
    marks = np.zeros((len(log_odds), len(KINDS), WORDS), np.uint64)
    if data:
        plain, size = zlib.decompress(data), -(-len(marks) // 8)
        some = np.flatnonzero(np.unpackbits(np.frombuffer(plain[:size], np.uint8)))
        odd = np.frombuffer(plain[size:], np.uint64).reshape(len(KINDS), len(some), WORDS).transpose(1, 0, 2).copy()
        odd[:, [QUIET, STILL]] ^= _occupied(log_odds[some])[:, None]
        marks[some] = odd
    return marks


def _occupied(log_odds: NDArray[np.int8]) -> NDArray[np.uint64]:
    return np.packbits(log_odds >= 0, axis=1, bitorder="little").view(np.uint64)


def regions_of(block_xyz: NDArray[Any]) -> NDArray[np.int64]:
    """Positions (N, 3) of the regions of blocks at (N, 3)."""
    regions: NDArray[np.int64] = block_xyz.astype(np.int64) >> _SHIFT
    return regions


def keys_of(regions: NDArray[np.int64]) -> NDArray[np.int64]:
    """One number (N,) per region at (N, 3), growing with x, then y, then z."""
    x, y, z = (regions + _HALF_RANGE).T
    keys: NDArray[np.int64] = x << 42 | y << 21 | z
    return keys


def positions_of(keys: NDArray[np.int64]) -> NDArray[np.int64]:
    """Positions (N, 3) of the regions of `keys` (N,)."""
    positions: NDArray[np.int64] = np.stack([keys >> 42, keys >> 21 & _AXIS, keys & _AXIS], axis=-1) - _HALF_RANGE
    return positions


def in_region_order(block_xyz: NDArray[np.int32]) -> NDArray[np.int32]:
    """The positions (N, 3) sorted by region and place, as `Memory.parts` has them."""
    ordered: NDArray[np.int32] = block_xyz[np.lexsort((places_of(block_xyz), keys_of(regions_of(block_xyz))))]
    return ordered


def places_of(block_xyz: NDArray[Any]) -> NDArray[np.int64]:
    """Place (N,) of each block inside its region, 0 .. PLACES - 1, z fastest."""
    x, y, z = (block_xyz.astype(np.int64) & (SHAPE - 1)).T
    places: NDArray[np.int64] = x << 5 | y << 2 | z
    return places


def all_blocks(key: int) -> NDArray[np.int64]:
    """Positions (PLACES, 3) of all the blocks that the region can have, in order of their places."""
    return np.asarray(_corner(key) + _PLACE_XYZ)


def _corner(key: int) -> NDArray[np.int64]:
    return np.asarray(positions_of(np.array([key]))[0] << _SHIFT)


@njit(cache=True, nogil=True)
def region_key(x, y, z):  # type: ignore[no-untyped-def]
    """As `keys_of`, of the region that holds block (x, y, z)."""
    i, j, k = i64(x) >> _X, i64(y) >> _Y, i64(z) >> _Z
    return (i + _HALF_RANGE) << 42 | (j + _HALF_RANGE) << 21 | (k + _HALF_RANGE)


_PLACE_XYZ = np.stack(np.unravel_index(np.arange(PLACES), SHAPE), axis=1)
