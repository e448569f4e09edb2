"""One scan's bits added to the log-odds of the blocks that they fall into."""

from __future__ import annotations

import numpy as np
from numba import njit

from companion.mapping.cell_word import CELLS_PER_WORD, update_word
from companion.mapping.rays import WORDS

i8, u8, u64 = np.int8, np.uint8, np.uint64
MARKS = CAME, FRESH, MISSED, QUIET, STILL, PROVEN = 0, 1, 2, 3, 4, 5
"""Bits per cell, for decay: it was at the lower clamp when it was hit; since the last pass hit, and passed
by rays; occupied without a hit between the last two passes, and the two before; proven to stay."""
PASSES = 4  # after which a block that no scan stirs holds nothing stale any more


@njit(cache=True, nogil=True)
def fold_bits(met, rows, words, blocks, amounts, changed):  # type: ignore[no-untyped-def]
    """One miss for each free bit without a hit bit, one hit for each hit bit; clears both.

    A miss cannot change a settled cell, so words of a place seen before cost nothing more.
    """
    free, hit = words
    log_odds, settled, all_marks, stirred = blocks
    steps = (i8(amounts[0]), i8(amounts[1]), i8(amounts[2]), i8(amounts[3]))
    for m in range(met.size):
        f, h, row = free[met[m]], hit[met[m]], rows[m]
        cells, done, marks = log_odds[row], settled[row], all_marks[row]
        differ = news = u64(0)
        for w in range(WORDS):
            missed = f[w] & ~(h[w] | done[w])
            if missed | h[w] != u64(0):
                news |= _mark((missed, h[w]), done[w], marks, w)
                crossed, done[w] = update_word(cells, w * CELLS_PER_WORD, (missed, h[w]), steps)
                differ |= crossed
            f[w] = h[w] = u64(0)
        if news != u64(0):
            stirred[row] = PASSES
        changed[m] = u8(differ != u64(0))


@njit(cache=True, nogil=True)
def _mark(bits, settled, marks, w):  # type: ignore[no-untyped-def]
    """Note for decay what befell which cell; returns the bits of those that concern it."""
    missed, hit = bits
    marks[CAME, w] |= hit & settled
    marks[FRESH, w] |= hit
    marks[MISSED, w] |= missed
    return hit | (missed & marks[QUIET, w])
