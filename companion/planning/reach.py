"""Is there a way at all? Flood fill at the resolution of the cells, a column of 64 cells at a time.

Two free cells are joined if they share a face. Cells of a column are bits of words; a word spreads along the column
in twelve shifts, and to the four columns beside it by one AND each.

>>> reach = Reach(space.steps, np.array([3, 4, 5]), np.array([90, 80, 20]))
>>> reach.joined(most_columns=4000), reach.joined()  # None: not known yet
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

WORD = 64
_ENCLOSED, _JOINED, _OPEN = range(3)
Cell = NDArray[np.int64]


class Reach:
    """Do free cells lead from cell `start` (3,) to cell `goal`? `steps` (X, Y, Z), 0: blocked."""

    def __init__(self, steps: NDArray[np.uint8], start: Cell, goal: Cell) -> None:
        words = -(-steps.shape[2] // WORD)
        packed = np.zeros((*steps.shape[:2], words * WORD // 8), np.uint8)
        bits = np.packbits(steps != 0, axis=2, bitorder="little")
        packed[:, :, : bits.shape[2]] = bits
        self._free, self._ends = packed.view("<u8").astype(np.uint64, copy=False), (start, goal)

    def joined(self, *, most_columns: int = 1 << 62) -> bool | None:
        """Exact; None: not decided by filling so many columns from the goal."""
        code = flood(self._free, *self._ends, most_columns)
        return None if code == _OPEN else bool(code == _JOINED)


@njit(cache=True, nogil=True)
def flood(free, start, goal, most):  # type: ignore[no-untyped-def]
    """From the goal until the start is met or nothing is left; `free` (X, Y, W) holds columns as bits."""
    nx, ny = free.shape[:2]
    reached, waits = np.zeros(free.shape, np.uint64), np.zeros((nx, ny), np.bool_)
    ring = np.empty((nx * ny, 2), np.int32)
    first, count = 0, 1
    ring[0, 0], ring[0, 1] = goal[0], goal[1]
    reached[goal[0], goal[1], goal[2] // WORD] = np.uint64(1) << np.uint64(goal[2] % WORD)
    word, bit = start[2] // WORD, np.uint64(1) << np.uint64(start[2] % WORD)
    while count > 0:
        if most == 0:
            return _OPEN
        most -= 1
        i, j = ring[first, 0], ring[first, 1]
        first, count = (first + 1) % ring.shape[0], count - 1
        waits[i, j] = False
        _spread(free[i, j], reached[i, j])
        if reached[start[0], start[1], word] & bit:
            return _JOINED
        for di, dj in ((-1, 0), (1, 0), (0, -1), (0, 1)):
            m, n = i + di, j + dj
            if not (0 <= m < nx and 0 <= n < ny):
                continue
            if _pass_on(reached[i, j], free[m, n], reached[m, n]) and not waits[m, n]:
                waits[m, n] = True
                last = (first + count) % ring.shape[0]
                ring[last, 0], ring[last, 1] = m, n
                count += 1
    return _ENCLOSED


@njit(cache=True, nogil=True)
def _spread(free, reached):  # type: ignore[no-untyped-def]
    """Fill up and down along a column (Kogge-Stone), then across the borders of its words."""
    top, one = np.uint64(WORD - 1), np.uint64(1)
    while True:
        for w in range(len(free)):
            up, down, through_up, through_down = reached[w], reached[w], free[w], free[w]
            for n in range(6):
                shift = one << np.uint64(n)
                up |= through_up & (up << shift)
                through_up &= through_up << shift
                down |= through_down & (down >> shift)
                through_down &= through_down >> shift
            reached[w] = up | down
        more = False
        for w in range(len(free) - 1):
            below, above = reached[w] >> top & one, reached[w + 1] & one
            if below != above and free[w] >> top & one and free[w + 1] & one:
                reached[w] |= one << top
                reached[w + 1] |= one
                more = True
        if not more:
            return


@njit(cache=True, nogil=True)
def _pass_on(from_, free, to):  # type: ignore[no-untyped-def]
    """Reach the free cells beside reached ones; were there new ones?"""
    new = False
    for w in range(len(free)):
        more = from_[w] & free[w] & ~to[w]
        to[w] |= more
        new = new or more != 0
    return new
