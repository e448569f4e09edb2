"""One ray against height field and cones, without a mesh: for the range finder and for checks."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numba import njit
from numpy.typing import NDArray

from companion.core.messages import Array
from sim.world.terrain import _height

if TYPE_CHECKING:
    from sim.world.model import World

_CELL_M = 1.0


@dataclass(frozen=True, eq=False)
class ConeGrid:
    """Cones per cell: those of cell (i, j) are items[start[k]:start[k + 1]], k = i * ny + j."""

    origin_xy: Array  # (2,)
    shape: tuple[int, int]  # nx, ny, cells of 1 m
    start: NDArray[np.int64]  # (nx * ny + 1,)
    items: NDArray[np.int64]


def grid_of(cones: Array) -> ConeGrid:
    """Sort cones (M, 9) into columns of 1 m by their boxes in x and y."""
    if not len(cones):
        return ConeGrid(np.zeros(2), (1, 1), np.zeros(2, np.int64), np.zeros(0, np.int64))
    base, tip = cones[:, :2], cones[:, :2] + cones[:, 6:7] * cones[:, 3:5]
    radius = np.maximum(cones[:, 7], cones[:, 8])[:, None]
    low, high = np.minimum(base, tip) - radius, np.maximum(base, tip) + radius
    origin = np.floor(low.min(axis=0))
    first = ((low - origin) / _CELL_M).astype(np.int64)
    span = ((high - origin) / _CELL_M).astype(np.int64) - first + 1
    shape = tuple(int(n) for n in (first + span).max(axis=0))
    count = span[:, 0] * span[:, 1]
    item = np.repeat(np.arange(len(cones)), count)
    k = np.arange(len(item)) - np.repeat(np.cumsum(count) - count, count)
    i, j = first[item, 0] + k // span[item, 1], first[item, 1] + k % span[item, 1]
    cell = i * shape[1] + j
    start = np.concatenate([[0], np.cumsum(np.bincount(cell, minlength=shape[0] * shape[1]))])
    return ConeGrid(origin, (shape[0], shape[1]), start, item[np.argsort(cell, kind="stable")])


def first_hit(world: World, p_world: Array, direction: Array, max_range_m: float) -> float:
    """Distance along a unit direction to the first surface; inf if none within `max_range_m`."""
    p, d = np.asarray(p_world, np.float64), np.asarray(direction, np.float64)
    if not (np.all(np.isfinite(p)) and np.all(np.isfinite(d))):
        return math.inf
    g = world.grid
    ground = _ground_hit(world.heights, world.origin_xy, world.cell_m, p, d, max_range_m)
    hit = _cone_hit(world.cones, g.origin_xy, g.shape, g.start, g.items, p, d, min(ground, max_range_m))
    return float(hit if hit < max_range_m else ground)


@njit(cache=True, nogil=True)
def _ground_hit(heights, origin_xy, cell_m, p, d, reach):  # type: ignore[no-untyped-def]
    """March in steps of a third of a cell, then bisect; a start below the ground gives 0."""
    level = abs(d[0]) + abs(d[1])
    step = 0.34 * cell_m / level if level > 0.34 * cell_m / reach else reach
    before = 0.0
    if p[2] <= _height(heights, origin_xy, cell_m, p[0], p[1]):
        return 0.0
    while before < reach:
        after = min(before + step, reach)
        x, y, z = p[0] + after * d[0], p[1] + after * d[1], p[2] + after * d[2]
        if z <= _height(heights, origin_xy, cell_m, x, y):
            for _ in range(40):
                t = 0.5 * (before + after)
                x, y, z = p[0] + t * d[0], p[1] + t * d[1], p[2] + t * d[2]
                if z <= _height(heights, origin_xy, cell_m, x, y):
                    after = t
                else:
                    before = t
            return after
        before = after
    return np.inf


@njit(cache=True, nogil=True)
def _cone_hit(cones, origin_xy, shape, start, items, p, d, reach):  # type: ignore[no-untyped-def]
    """Walk the columns that the ray crosses (Amanatides and Woo, 1987)."""
    x, y = p[0] - origin_xy[0], p[1] - origin_xy[1]
    i, j = math.floor(x), math.floor(y)
    si, sj = 1 if d[0] > 0 else -1, 1 if d[1] > 0 else -1
    dt_x = 1.0 / abs(d[0]) if d[0] != 0.0 else np.inf
    dt_y = 1.0 / abs(d[1]) if d[1] != 0.0 else np.inf
    next_x = (i + (si > 0) - x) / d[0] if d[0] != 0.0 else np.inf
    next_y = (j + (sj > 0) - y) / d[1] if d[1] != 0.0 else np.inf
    best, t = reach, 0.0
    while t < best:
        if 0 <= i < shape[0] and 0 <= j < shape[1]:
            k = i * shape[1] + j
            for q in range(start[k], start[k + 1]):
                best = _frustum(cones[items[q]], p, d, best)
        t = min(next_x, next_y)
        if next_x < next_y:
            next_x += dt_x
            i += si
        else:
            next_y += dt_y
            j += sj
    return best


@njit(cache=True, nogil=True)
def _frustum(cone, p, d, best):  # type: ignore[no-untyped-def]
    """Nearest entry into the side of a cone frustum if nearer than `best`, else `best`."""
    wx, wy, wz = p[0] - cone[0], p[1] - cone[1], p[2] - cone[2]
    slope = (cone[8] - cone[7]) / cone[6]
    d_axis = d[0] * cone[3] + d[1] * cone[4] + d[2] * cone[5]
    w_axis = wx * cone[3] + wy * cone[4] + wz * cone[5]
    radius = cone[7] + slope * w_axis
    a = 1.0 - d_axis * d_axis * (1.0 + slope * slope)
    b = wx * d[0] + wy * d[1] + wz * d[2] - w_axis * d_axis - slope * d_axis * radius
    c = wx * wx + wy * wy + wz * wz - w_axis * w_axis - radius * radius
    square = b * b - a * c
    if square <= 0.0 or a < 1e-12:
        return best
    t = (-b - math.sqrt(square)) / a
    along = w_axis + t * d_axis
    if 0.0 < t < best and 0.0 <= along <= cone[6]:
        return t
    return best
