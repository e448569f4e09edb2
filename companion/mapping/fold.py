"""One scan's bits added to the log-odds of the blocks that they fall into."""

from __future__ import annotations

import numpy as np
from numba import njit

from companion.mapping.rays import CELLS, WORDS
from companion.mapping.sensor_model import UNKNOWN

i16, u8, u64 = np.int16, np.uint8, np.uint64
MARKS = CAME, FRESH, MISSED, QUIET, STILL, PROVEN = 0, 1, 2, 3, 4, 5
"""Bits per cell, for decay: it was at the lower clamp when it was hit; since the last pass hit, and passed
by rays; occupied without a hit between the last two passes, and the two before; proven to stay."""
PASSES = 4  # after which a block that no scan stirs holds nothing stale any more


@njit(cache=True, nogil=True)
def fold_bits(met, rows, words, blocks, amounts, changed):  # type: ignore[no-untyped-def]
    """One miss for each free bit without a hit bit, one hit for each hit bit; clears both.

    A miss cannot change a settled cell, so most blocks of a place seen before are skipped.
    """
    free, hit = words
    log_odds, settled, all_marks, stirred = blocks
    octets = np.empty((2, CELLS // 8), np.uint64)  # of cells that get a miss, a hit
    for m in range(met.size):
        f, h, row = free[met[m]], hit[met[m]], rows[m]
        done = settled[row]
        any_bit = u64(0)
        for w in range(WORDS):
            f[w] &= ~(h[w] | done[w])
            any_bit |= f[w] | h[w]
        if any_bit != u64(0):
            _mark(f, h, done, all_marks[row], stirred, row)
            _spread(f.view(np.uint8), octets[0])
            _spread(h.view(np.uint8), octets[1])
            cells = log_odds[row]
            changed[m] = _update(cells, octets[0].view(np.uint8), octets[1].view(np.uint8), amounts)
            _settle(cells.view(np.uint64), u8(amounts[2]), done.view(np.uint8))
        f[:] = u64(0)
        h[:] = u64(0)


@njit(cache=True, nogil=True)
def _mark(missed, hit, settled, marks, stirred, row):  # type: ignore[no-untyped-def]
    """Note for decay what befell which cell."""
    news = u64(0)
    for w in range(WORDS):
        marks[CAME, w] |= hit[w] & settled[w]
        marks[FRESH, w] |= hit[w]
        marks[MISSED, w] |= missed[w]
        news |= hit[w] | (missed[w] & marks[QUIET, w])
    if news != u64(0):
        stirred[row] = PASSES


@njit(cache=True, nogil=True)
def _spread(bits, octets):  # type: ignore[no-untyped-def]
    """Bit i of the bytes makes byte i of the octets not zero."""
    for n in range(CELLS // 8):
        octets[n] = (u64(bits[n]) * u64(0x0101010101010101)) & u64(0x8040201008040201)


@njit(cache=True, nogil=True)
def _update(cells, missed, hit, amounts):  # type: ignore[no-untyped-def]
    """Branch-free over the block; returns whether a cell changed its class."""
    unknown, zero = np.int8(UNKNOWN), np.int8(0)
    hit_step, miss_step, lowest, highest = amounts[0], amounts[1], amounts[2], amounts[3]
    differ = zero
    for c in range(CELLS):
        old = cells[c]
        level = i16(0) if old == unknown else i16(old)
        level = i16(level + (hit_step if hit[c] != u8(0) else miss_step))
        level = lowest if level < lowest else level
        level = highest if level > highest else level
        new = np.int8(level) if (missed[c] | hit[c]) != u8(0) else old
        cells[c] = new
        differ = np.int8(differ | np.int8(old ^ new))  # its sign bit: occupied <-> free or unknown
        differ = np.int8(differ | (unknown if (old == unknown and new != unknown) else zero))
    return u8(differ < zero)


@njit(cache=True, nogil=True)
def _settle(octets, lowest, bits):  # type: ignore[no-untyped-def]
    """Set the bits of the cells that equal `lowest`; eight cells are one octet and one byte of bits."""
    low, top, gather = u64(0x7F7F7F7F7F7F7F7F), u64(0x0101010101010101), u64(0x0102040810204080)
    pattern = u64(lowest) * top
    for n in range(CELLS // 8):
        x = octets[n] ^ pattern
        zero_bytes = (~(((x & low) + low) | x | low)) >> u64(7)  # 1 in each byte that is zero
        bits[n] = u8((zero_bytes * gather) >> u64(56))
