"""Open-addressing hash of block positions, laid out so that neighbours share a cache line."""

from __future__ import annotations

import numpy as np
from numba import njit

i64, u64 = np.int64, np.uint64
EMPTY = -1  # key of a slot that is not in use
_STRIDE = 17  # slots from try to try: past the neighbours, whose slots are taken, and odd, so that all have their turn
_STRIDES_PER_SLOT = u64(pow(_STRIDE, -1, 1 << 64))


@njit(cache=True, nogil=True)
def find_scratch(met, grid, table, rows):  # type: ignore[no-untyped-def]
    """Row of each scratch block of `grid` = (side, corner), -1: not there; returns how many are not."""
    keys, values = table
    missing = 0
    for m in range(met.size):
        x, y, z = _place(met[m], grid)
        slot = slot_of(keys, x, y, z)
        rows[m] = -1 if keys[slot] == EMPTY else values[slot]
        missing += keys[slot] == EMPTY
    return missing


@njit(cache=True, nogil=True)
def make_scratch(met, grid, table, count, rows):  # type: ignore[no-untyped-def]
    """Make the blocks that were not there, in rows from `count` on."""
    keys, values, xyz = table
    for m in range(met.size):
        if rows[m] < 0:
            x, y, z = _place(met[m], grid)
            slot = slot_of(keys, x, y, z)
            keys[slot], values[slot] = key_of(x, y, z), count
            xyz[count, 0], xyz[count, 1], xyz[count, 2] = x, y, z
            rows[m] = count
            count += 1


@njit(cache=True, nogil=True)
def _place(number, grid):  # type: ignore[no-untyped-def]
    """Position of a scratch block."""
    side, corner = grid
    block, wide = np.uint32(number), np.uint32(side)
    line = block // wide
    i = line // wide
    return i64(i) + corner[0], i64(line - i * wide) + corner[1], i64(block - line * wide) + corner[2]


@njit(cache=True, nogil=True)
def enter(xyz, rows, keys, values):  # type: ignore[no-untyped-def]
    """Enter the blocks of `rows`; one that is there already gets its new row."""
    for row in rows:
        x, y, z = i64(xyz[row, 0]), i64(xyz[row, 1]), i64(xyz[row, 2])
        slot = slot_of(keys, x, y, z)
        keys[slot] = key_of(x, y, z)
        values[slot] = row


@njit(cache=True, nogil=True)
def find(xyz, table, rows):  # type: ignore[no-untyped-def]
    """Row of each block at `xyz` (N, 3); -1: not there."""
    keys, values = table
    for n in range(xyz.shape[0]):
        slot = slot_of(keys, xyz[n, 0], xyz[n, 1], xyz[n, 2])
        rows[n] = -1 if keys[slot] == EMPTY else values[slot]


@njit(cache=True, nogil=True)
def leave(xyz, rows, keys, values):  # type: ignore[no-untyped-def]
    """Take the blocks of `rows` out; what stands behind a gap moves into it if its probing began before."""
    mask = i64(keys.size - 1)
    for row in rows:
        gap = slot_of(keys, i64(xyz[row, 0]), i64(xyz[row, 1]), i64(xyz[row, 2]))
        slot = (gap + _STRIDE) & mask
        while keys[slot] != EMPTY:
            other = values[slot]
            home = _home(mask, i64(xyz[other, 0]), i64(xyz[other, 1]), i64(xyz[other, 2]))
            if _tries(slot - home, mask) >= _tries(slot - gap, mask):
                keys[gap], values[gap] = keys[slot], values[slot]
                gap = slot
            slot = (slot + _STRIDE) & mask
        keys[gap] = EMPTY


@njit(cache=True, nogil=True)
def _tries(slots, mask):  # type: ignore[no-untyped-def]
    """How many tries farther a slot is that is so many slots farther."""
    return i64(u64(slots) * _STRIDES_PER_SLOT) & mask


@njit(cache=True, nogil=True)
def slot_of(keys, x, y, z):  # type: ignore[no-untyped-def]
    """Where block (x, y, z) is or would go."""
    key = key_of(x, y, z)
    mask = i64(keys.size - 1)
    slot = _home(mask, x, y, z)
    while keys[slot] != key and keys[slot] != EMPTY:
        slot = (slot + _STRIDE) & mask
    return slot


@njit(cache=True, nogil=True)
def _home(mask, x, y, z):  # type: ignore[no-untyped-def]
    """Where probing begins. 2x2x4 neighbours share 16 slots in a row (locality)."""
    h = u64(x >> 1) * u64(0x9E3779B97F4A7C15)
    h ^= u64(y >> 1) * u64(0xC2B2AE3D27D4EB4F) ^ u64(z >> 2) * u64(0x165667B19E3779F9)
    h ^= h >> u64(29)
    return (i64((h >> u64(20)) << u64(4)) | ((x & 1) << 3) | ((y & 1) << 2) | (z & 3)) & mask


@njit(cache=True, nogil=True)
def key_of(x, y, z):  # type: ignore[no-untyped-def]
    """21 bits per axis: 1,600 km of 0.2 m cells either way."""
    return ((x & 0x1FFFFF) << 42) | ((y & 0x1FFFFF) << 21) | (z & 0x1FFFFF)
