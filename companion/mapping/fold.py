"""One scan's bits added to the log-odds of the blocks that they fall into."""

from __future__ import annotations

import numpy as np
from numba import njit

from companion.core.prefetch import prefetch
from companion.mapping.cell_word import CELLS_PER_WORD, update_word
from companion.mapping.marks import PASSES, PROVEN, mark
from companion.mapping.rays import WORDS

_AHEAD = 8  # blocks
i8, u8, u64 = np.int8, np.uint8, np.uint64


@njit(cache=True, nogil=True)
def fold_bits(met, rows, words, blocks, amounts, changed):  # type: ignore[no-untyped-def]
    """One miss for each free bit without a hit bit, one hit for each hit bit; clears both.

    A miss cannot change a settled cell, so words of a place seen before cost nothing more. With
    `amounts[4]` misses of proven cells do not count. Arrays are flat, because a view of a row is counted as one more
    owner and given back, 10 ns each.
    """
    free, hit, hit_of = words
    (log_odds, settled), (marking, slots, stirred, table) = blocks
    steps = (i8(amounts[0]), i8(amounts[1]), i8(amounts[2]), i8(amounts[3]))
    spares, marks = marking and amounts[4] != 0, table[0]
    free_words, hit_words, done, cells = free.reshape(-1), hit.reshape(-1), settled.reshape(-1), log_odds.reshape(-1)
    for m in range(min(_AHEAD, met.size)):
        _fetch(met[m], rows[m], words, blocks)
    for m in range(met.size):
        if m + _AHEAD < met.size:
            _fetch(met[m + _AHEAD], rows[m + _AHEAD], words, blocks)
        number, row = u64(met[m]), u64(rows[m])
        struck = u64(hit_of[number])
        if marking and (struck != u64(0) or slots[row] != 0):
            slots[row], news = mark(slots[row], (free[number], hit[struck], settled[row]), table)
            if news:
                stirred[row] = PASSES
        differ, slot = u64(0), slots[row]
        for w in range(WORDS):
            f, h, s = number * u64(WORDS) + u64(w), struck * u64(WORDS) + u64(w), row * u64(WORDS) + u64(w)
            missed = free_words[f] & ~(hit_words[h] | done[s])
            if spares:
                missed &= ~marks[slot, PROVEN, w]
            if missed | hit_words[h] != u64(0):
                crossed, done[s] = update_word(cells, s * u64(CELLS_PER_WORD), (missed, hit_words[h]), steps)
                differ |= crossed
            free_words[f] = hit_words[h] = u64(0)
        hit_of[number] = 0
        changed[m] = u8(differ != u64(0))


@njit(cache=True, nogil=True)
def _fetch(number, row, words, blocks):  # type: ignore[no-untyped-def]
    """Ask for what the block will need."""
    (free, _, hit_of), (log_odds, settled) = words, blocks[0]
    prefetch(free, number * WORDS)
    prefetch(hit_of, number)
    prefetch(settled, row * WORDS)
    for w in range(WORDS):
        prefetch(log_odds, (row * WORDS + w) * CELLS_PER_WORD)
