"""One ray against height field and cones, without a mesh: for the range finder and for checks."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from numba import njit

from companion.core.messages import Array
from sim.world.columns import Columns, columns_crossed, sort_into_columns
from sim.world.terrain import _height

if TYPE_CHECKING:
    from sim.world.model import World


def sort_cones(cones: Array) -> Columns:
    """Columns of cones (M, 9)."""
    base, tip = cones[:, :2], cones[:, :2] + cones[:, 6:7] * cones[:, 3:5]
    radius = np.maximum(cones[:, 7], cones[:, 8])[:, None]
    return sort_into_columns(np.minimum(base, tip) - radius, np.maximum(base, tip) + radius)


def first_hit(world: World, p_world: Array, direction: Array, max_range_m: float) -> float:
    """Distance along a unit direction to the first surface; inf if none within `max_range_m`."""
    p, d = np.asarray(p_world, np.float64), np.asarray(direction, np.float64)
    if not (np.all(np.isfinite(p)) and np.all(np.isfinite(d))):
        return math.inf
    g = world.grid
    ground = _ground_hit(world.heights, world.origin_xy, world.cell_m, p, d, max_range_m)
    hit = _cone_hit(world.cones, g.frame, g.start, g.items, p, d, min(ground, max_range_m))
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
def _cone_hit(cones, frame, start, items, p, d, reach):  # type: ignore[no-untyped-def]
    columns, entered = columns_crossed(frame, p, d, reach)
    best = reach
    for n in range(columns.size):
        if entered[n] >= best:
            break
        for q in range(start[columns[n]], start[columns[n] + 1]):
            best = _frustum(cones[items[q]], p, d, best)
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
