"""Blocks after a rigid motion: each new cell takes what its centre was in, and nothing solid is lost.

Where the motion turns, a few cells have no new cell whose centre they held. Free space can spare
them; an occupied one marks the cell that its own centre comes to, so that no pole or wall opens.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from companion.core.messages import Array
from companion.mapping.evidence import Levels
from companion.mapping.pose_track import PoseShift
from companion.mapping.rays import BLOCK, CELLS

u64 = np.uint64
_NOTHING = 0x8080808080808080  # eight unknown cells
_MIDDLE = 0.5 * (BLOCK - 1)


class MovedBlocks:
    """Blocks (N, 3) of values (N, 512) moved by `shift`; `xyz` (M, 3) are the blocks they come to lie in.

    A line of eight cells along z is moved as one piece: exact unless the motion tilts, and then
    off by at most half a cell at 7 degrees of tilt.
    """

    def __init__(self, xyz: NDArray[np.int32], values: Levels, shift: PoseShift, resolution_m: float) -> None:
        self.values = values
        self._still = bool(np.array_equal(shift.R, np.eye(3)) and not shift.t.any())
        self._R, self._t = shift.R, shift.t / resolution_m
        if self._still or len(xyz) == 0:
            self.xyz = xyz
            return
        self._corner = xyz.min(axis=0).astype(np.int64)
        self._index = np.full(xyz.max(axis=0) - self._corner + 1, -1, np.int32)
        self._index[tuple((xyz - self._corner).T)] = np.arange(len(xyz))
        self.xyz = _blocks_met(xyz, self._R, self._t)
        self._lost_rows, self._lost_cells = self._lost(xyz)

    def cells(self, first: int, last: int) -> Levels:
        """Values (last - first, 512) of those blocks of `xyz`."""
        if self._still:
            return self.values[first:last]
        moved = np.empty((last - first, CELLS), np.int8)
        words = self.values.view(np.uint64)
        _compose(self.xyz[first:last], (self._R, self._t), (self._index, self._corner, words), moved.view(np.uint64))
        a, b = np.searchsorted(self._lost_rows, [first, last])
        where = (self._lost_rows[a:b] - first, self._lost_cells[a:b, 0])
        np.maximum.at(moved, where, self._lost_cells[a:b, 1].astype(np.int8))
        return moved

    def _lost(self, xyz: NDArray[np.int32]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Occupied cells that no new centre lies in: new row (L,), ascending; new cell and value (L, 2)."""
        occupied = int(np.count_nonzero(self.values >= 0))
        found = np.empty((occupied, 5), np.int64)
        count = _lost(xyz, self.values, (self._R, self._t), found)
        lowest = self.xyz.min(axis=0).astype(np.int64)
        rows = np.empty(self.xyz.max(axis=0) - lowest + 1, np.int64)
        rows[tuple((self.xyz - lowest).T)] = np.arange(len(self.xyz))
        row = rows[tuple((found[:count, :3] - lowest).T)]
        order = np.argsort(row, kind="stable")
        return row[order], found[:count, 3:][order]


def _blocks_met(xyz: NDArray[np.int32], R: Array, t: Array) -> NDArray[np.int32]:
    """Blocks (M, 3), in order of position, that blocks (N, 3) can reach when they move; `t` in cells."""
    center = BLOCK * (xyz + 0.5) @ R.T + t
    reach = np.abs(R).sum(axis=1) * BLOCK / 2
    low = np.floor((center - reach) / BLOCK).astype(np.int64)
    high = np.floor((center + reach) / BLOCK).astype(np.int64)
    corner = low.min(axis=0)
    there = np.zeros(high.max(axis=0) - corner + 1, np.uint8)
    _mark(low - corner, high - corner, there)
    met: NDArray[np.int32] = (np.argwhere(there) + corner).astype(np.int32, order="C")  # argwhere's is Fortran's
    return met


@njit(cache=True, nogil=True)
def _mark(low, high, there):  # type: ignore[no-untyped-def]
    for n in range(low.shape[0]):
        for i in range(low[n, 0], high[n, 0] + 1):
            for j in range(low[n, 1], high[n, 1] + 1):
                for k in range(low[n, 2], high[n, 2] + 1):
                    there[i, j, k] = 1


@njit(cache=True, nogil=True)
def _compose(xyz, motion, source, lines):  # type: ignore[no-untyped-def]
    """Fill `lines` (M, 64), eight cells along z each, of the new blocks at `xyz`."""
    index, corner, words = source
    nothing = u64(_NOTHING)
    for m in range(xyz.shape[0]):
        for line in range(BLOCK * BLOCK):
            x, y, z = _came_from(BLOCK * xyz[m, 0] + (line >> 3), BLOCK * xyz[m, 1] + (line & 7), xyz[m, 2], motion)
            i, j, k = (x >> 3) - corner[0], (y >> 3) - corner[1], (z >> 3) - corner[2]
            low = high = nothing
            if 0 <= i < index.shape[0] and 0 <= j < index.shape[1]:
                inside = ((x & 7) << 3) | (y & 7)
                if 0 <= k < index.shape[2] and index[i, j, k] >= 0:
                    low = words[index[i, j, k], inside]
                if 0 <= k + 1 < index.shape[2] and index[i, j, k + 1] >= 0:
                    high = words[index[i, j, k + 1], inside]
            by = u64((z & 7) << 3)
            lines[m, line] = low if by == u64(0) else (low >> by) | (high << (u64(64) - by))


@njit(cache=True, nogil=True)
def _came_from(x, y, block_z, motion):  # type: ignore[no-untyped-def]
    """Old cell of the first of the eight cells at column (x, y) of a block, the middle of the line being exact."""
    R, t = motion
    a, b, c = x + 0.5 - t[0], y + 0.5 - t[1], BLOCK * block_z + 0.5 * BLOCK - t[2]
    old_x = R[0, 0] * a + R[1, 0] * b + R[2, 0] * c
    old_y = R[0, 1] * a + R[1, 1] * b + R[2, 1] * c
    old_z = R[0, 2] * a + R[1, 2] * b + R[2, 2] * c
    return math.floor(old_x), math.floor(old_y), math.floor(old_z - _MIDDLE)


@njit(cache=True, nogil=True)
def _lost(xyz, values, motion, found):  # type: ignore[no-untyped-def]
    """Write (new block, new cell, value) of the occupied cells that `_compose` takes nowhere; returns how many."""
    R, t = motion
    words = values.view(np.uint64)
    count = 0
    for n in range(xyz.shape[0]):
        for line in range(BLOCK * BLOCK):
            if ~words[n, line] & u64(_NOTHING) == u64(0):  # all eight are below 0
                continue
            for z in range(BLOCK):
                value = values[n, (line << 3) | z]
                if value < np.int8(0):
                    continue
                x, y = BLOCK * xyz[n, 0] + (line >> 3), BLOCK * xyz[n, 1] + (line & 7)
                a, b, c = x + 0.5, y + 0.5, BLOCK * xyz[n, 2] + z + 0.5
                i = math.floor(R[0, 0] * a + R[0, 1] * b + R[0, 2] * c + t[0])
                j = math.floor(R[1, 0] * a + R[1, 1] * b + R[1, 2] * c + t[1])
                k = math.floor(R[2, 0] * a + R[2, 1] * b + R[2, 2] * c + t[2])
                if _taken((x, y, BLOCK * xyz[n, 2] + z), (i, j, k), motion):
                    continue
                found[count, 0], found[count, 1], found[count, 2] = i >> 3, j >> 3, k >> 3
                found[count, 3], found[count, 4] = ((i & 7) << 6) | ((j & 7) << 3) | (k & 7), value
                count += 1
    return count


@njit(cache=True, nogil=True)
def _taken(old, new, motion):  # type: ignore[no-untyped-def]
    """Whether cell `new` or one of its neighbours takes what cell `old` holds."""
    for n in range(27):
        i, j, k = new[0] + (n // 3) % 3 - 1, new[1] + n % 3 - 1, new[2] + n // 9 - 1
        if n == 0:  # most often
            i, j, k = new
        elif n == 13:
            i, j, k = new[0] - 1, new[1] - 1, new[2] - 1
        x, y, z = _came_from(i, j, k >> 3, motion)
        if x == old[0] and y == old[1] and z + (k & 7) == old[2]:
            return True
    return False
