"""Things sorted into columns of 1 m by their boxes in x and y: who is near a place, whom can a ray meet."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from companion.core.messages import Array

_CELL_M = 1.0


@dataclass(frozen=True, eq=False)
class Columns:
    """Things per column: those of column (i, j) are items[start[k]:start[k + 1]], k = i * ny + j."""

    frame: Array  # (4,): corner x, y, m, and how many columns there are in x, y
    start: NDArray[np.int64]  # (nx * ny + 1,)
    items: NDArray[np.int64]


def sort_into_columns(low_xy: Array, high_xy: Array) -> Columns:
    """Columns of things with boxes from `low_xy` (M, 2) to `high_xy` (M, 2), m."""
    if not len(low_xy):
        return Columns(np.array([0.0, 0.0, 1.0, 1.0]), np.zeros(2, np.int64), np.zeros(0, np.int64))
    origin = np.floor(low_xy.min(axis=0))
    first = ((low_xy - origin) / _CELL_M).astype(np.int64)
    span = ((high_xy - origin) / _CELL_M).astype(np.int64) - first + 1
    shape = (first + span).max(axis=0)
    count = span[:, 0] * span[:, 1]
    item = np.repeat(np.arange(len(low_xy)), count)
    k = np.arange(len(item)) - np.repeat(np.cumsum(count) - count, count)
    column = (first[item, 0] + k // span[item, 1]) * shape[1] + first[item, 1] + k % span[item, 1]
    start = np.concatenate([[0], np.cumsum(np.bincount(column, minlength=int(shape[0] * shape[1])))])
    return Columns(np.array([*origin, *shape], np.float64), start, item[np.argsort(column, kind="stable")])


@njit(cache=True, nogil=True)
def columns_crossed(frame, p, d, reach):  # type: ignore[no-untyped-def]
    """Columns that a ray crosses within `reach`, in order, and how far along it enters each.

    J. Amanatides and A. Woo, "A Fast Voxel Traversal Algorithm for Ray Tracing", 1987.
    """
    x, y, nx, ny = p[0] - frame[0], p[1] - frame[1], int(frame[2]), int(frame[3])
    columns, entered = np.empty(nx + ny, np.int64), np.empty(nx + ny)
    i, j, count, t = math.floor(x), math.floor(y), 0, 0.0
    si, sj = 1 if d[0] > 0 else -1, 1 if d[1] > 0 else -1
    dt_x = 1.0 / abs(d[0]) if d[0] != 0.0 else np.inf
    dt_y = 1.0 / abs(d[1]) if d[1] != 0.0 else np.inf
    next_x = (i + (si > 0) - x) / d[0] if d[0] != 0.0 else np.inf
    next_y = (j + (sj > 0) - y) / d[1] if d[1] != 0.0 else np.inf
    while t < reach:
        if 0 <= i < nx and 0 <= j < ny:
            columns[count], entered[count] = i * ny + j, t
            count += 1
        t = min(next_x, next_y)
        if next_x < next_y:
            next_x += dt_x
            i += si
        else:
            next_y += dt_y
            j += sj
    return columns[:count], entered[:count]


@njit(cache=True, nogil=True)
def items_near(frame, start, items, x, reach, seen, found):  # type: ignore[no-untyped-def]
    """Write every item once whose columns meet the square of `reach` around x (2+,); returns how many.

    `seen` (M + 1,) is scratch that only this function writes.
    """
    seen[-1] += 1
    nx, ny, count = int(frame[2]), int(frame[3]), 0
    i0, i1 = max(math.floor(x[0] - reach - frame[0]), 0), min(math.floor(x[0] + reach - frame[0]), nx - 1)
    j0, j1 = max(math.floor(x[1] - reach - frame[1]), 0), min(math.floor(x[1] + reach - frame[1]), ny - 1)
    for i in range(i0, i1 + 1 if j1 >= j0 else i0):
        for k in range(start[i * ny + j0], start[i * ny + j1 + 1]):
            if seen[items[k]] != seen[-1]:
                seen[items[k]] = seen[-1]
                found[count] = items[k]
                count += 1
    return count
