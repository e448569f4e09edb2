"""What decay knows of single cells: bits for those blocks alone in which something was hit and still stands."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from companion.mapping.rays import WORDS

u64 = np.uint64
KINDS = CAME, FRESH, MISSED, QUIET, STILL, PROVEN = 0, 1, 2, 3, 4, 5
"""Bits per cell, for decay: it was at the lower clamp when it was hit; since the last pass hit, and passed
by rays while quiet; occupied without a hit between the last two passes, and the two before; proven to stay."""
MISSES_COUNT_EVERY = 4  # scans, for proven cells: most scans see through a thin branch that is still there
PASSES = 4  # after which a block that no scan stirs holds nothing stale any more
_GROWTH = 1024  # 0.4 MB


class MarkTable:
    """Marks (S, 6, 8) by slot; slot 0 is that of blocks without any, and always empty, as are free slots."""

    def __init__(self) -> None:
        self.bits = np.zeros((1, len(KINDS), WORDS), np.uint64)
        self.free = np.zeros(1, np.int32)  # the first `left` are free slots
        self.left = np.zeros(1, np.int64)

    @property
    def memory_bytes(self) -> int:
        """Bytes of memory."""
        return self.bits.nbytes + self.free.nbytes

    @property
    def arrays(self) -> tuple[NDArray[np.uint64], NDArray[np.int32], NDArray[np.int64]]:
        """(bits, free, left), as kernels want them."""
        return self.bits, self.free, self.left

    def reserve(self, count: int) -> None:
        """See that `count` slots are free."""
        left, size = int(self.left[0]), len(self.bits)
        if left >= count:
            return
        more = -(-(count - left) // _GROWTH) * _GROWTH
        self.bits.resize((size + more, *self.bits.shape[1:]), refcheck=False)
        self.free.resize(size + more, refcheck=False)
        self.free[left : left + more] = np.arange(size + more - 1, size - 1, -1)
        self.left[0] = left + more

    def store(self, marks: NDArray[np.uint64]) -> NDArray[np.int32]:
        """Take in marks (K, 6, 8); returns the slot (K,) of each."""
        slots = np.zeros(len(marks), np.int32)
        some = np.flatnonzero(marks.any(axis=(1, 2)))
        self.reserve(len(some))
        left = int(self.left[0]) - len(some)
        slots[some] = self.free[left : left + len(some)]
        self.bits[slots[some]] = marks[some]
        self.left[0] = left
        return slots

    def release(self, slots: NDArray[np.int32]) -> None:
        """The blocks with these slots (K,) are no more; 0 is ignored."""
        slots = slots[slots > 0]
        left = int(self.left[0])
        self.bits[slots] = 0
        self.free[left : left + len(slots)] = slots
        self.left[0] = left + len(slots)


@njit(cache=True, nogil=True)
def mark(slot, words, table):  # type: ignore[no-untyped-def]
    """Note what a scan did to a block, before it is done; returns (its slot, whether a pass has to look at it)."""
    missed, hit, settled = words  # bits before the scan's own are taken into account
    bits, free, left = table
    news = u64(0)
    if slot == 0:
        left[0] -= 1
        slot = free[left[0]]
    own = bits[slot]
    for w in range(WORDS):
        passed = missed[w] & ~(hit[w] | settled[w]) & own[QUIET, w]
        own[CAME, w] |= hit[w] & settled[w]
        own[FRESH, w] |= hit[w]
        own[MISSED, w] |= passed
        news |= hit[w] | passed
    return slot, news != u64(0)
