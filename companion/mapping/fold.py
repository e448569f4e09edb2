"""One scan's bits added to the log-odds of the blocks that they fall into."""

from __future__ import annotations

import numpy as np
from numba import njit

from companion.mapping.cell_word import CELLS_PER_WORD, update_word
from companion.mapping.marks import PASSES, PROVEN, mark
from companion.mapping.rays import WORDS

i8, u8, u64 = np.int8, np.uint8, np.uint64


@njit(cache=True, nogil=True)
def fold_bits(met, rows, words, blocks, amounts, changed):  # type: ignore[no-untyped-def]
    """One miss for each free bit without a hit bit, one hit for each hit bit; clears both.

    A miss cannot change a settled cell, so words of a place seen before cost nothing more. With
    `amounts[4]` misses of proven cells do not count.
    """
    free, hit, hit_of = words
    (log_odds, settled), (marking, slots, stirred, table) = blocks
    steps = (i8(amounts[0]), i8(amounts[1]), i8(amounts[2]), i8(amounts[3]))
    spares, marks = marking and amounts[4] != 0, table[0]
    for m in range(met.size):
        f, row, struck = free[met[m]], rows[m], hit_of[met[m]]
        h, cells, done = hit[struck], log_odds[row], settled[row]
        if marking and (struck != 0 or slots[row] != 0):
            slots[row], news = mark(slots[row], (f, h, done), table)
            if news:
                stirred[row] = PASSES
        differ, proven = u64(0), marks[slots[row], PROVEN]
        for w in range(WORDS):
            missed = f[w] & ~(h[w] | done[w])
            if spares:
                missed &= ~proven[w]
            if missed | h[w] != u64(0):
                crossed, done[w] = update_word(cells, w * CELLS_PER_WORD, (missed, h[w]), steps)
                differ |= crossed
            f[w] = h[w] = u64(0)
        hit_of[met[m]] = 0
        changed[m] = u8(differ != u64(0))
