"""What a local map says of segments, at any radius: free or not, inflated obstacles, the field's gradient.

Distances are those of cell centres (`DistanceField`): a cell is blocked for a sphere of radius r if
its distance is below r. With a cell's edge h, for a sphere that moves along a segment:

- free by the field => nothing occupied is nearer to the segment than r - 1.24 h,
- nothing occupied nearer than r + 0.87 h => free by the field.

(A point is at most sqrt(3)/2 h from its cell's centre, an obstacle's surface between 1/2 h and
sqrt(3)/2 h from its cell's.) `companion.mapping.queries.known_free` has no such margin, and its price.
"""

from __future__ import annotations

import math
from typing import Literal

import numpy as np
from numba import njit
from numpy.typing import NDArray

from companion.core.errors import InputError
from companion.core.messages import Array, Array32, LocalMap

Unknown = Literal["free", "occupied"]
_FARTHEST_M = 1e9
_LOSS = math.sqrt(3.0) + 1e-3  # cells: two points are that much nearer than their cells' centres, and rounding


def segment_free(
    local_map: LocalMap, a_odom: Array, b_odom: Array, radius_m: float, *, unknown: Unknown = "occupied"
) -> NDArray[np.bool_]:
    """Which of the segments from `a_odom` to `b_odom` (N, 3), m, meet no blocked cell, (N,).

    Every cell that a segment crosses is looked at (Amanatides and Woo 1987), but for those that the
    field proves free (sphere tracing, Hart 1996): same answer, fewer steps. What is not known, and
    all beyond the map, is an obstacle or free as `unknown` says; what is not finite is not free.
    Beyond the field's truncation every radius is blocked everywhere. InputError if the radius is not above 0.
    """
    field = _field(local_map, radius_m, unknown)
    a, b = (_cells(local_map, points) for points in (a_odom, b_odom))
    if a.shape != b.shape:
        raise InputError(f"{len(a)} begins and {len(b)} ends", field="b_odom", valid="as many of both")
    free = np.empty(len(a), np.bool_)
    _segments_free(field, a, b, (float(radius_m), local_map.resolution_m, unknown == "free"), free)
    return free


def inflated(local_map: LocalMap, radius_m: float, *, unknown: Unknown = "occupied") -> NDArray[np.bool_]:
    """The blocked cells (X, Y, Z) for a sphere of that radius, m."""
    return np.asarray(_field(local_map, radius_m, unknown) < np.float32(radius_m))


def gradient(local_map: LocalMap, points_odom: Array, *, unknown: Unknown = "free") -> Array:
    """Gradient (N, 3), m/m, of the trilinear field (`distance_field.interpolate`) at points (N, 3), m.

    It points away from the nearest obstacle; zero where the field is truncated or, along an axis,
    beyond the outermost cell centres; NaN where the point is not finite.
    """
    field = _chosen(local_map, unknown)
    last = np.array(field.shape) - 1
    cell = _cells(local_map, points_odom) - 0.5
    reach = np.where((cell >= 0.0) & (cell <= last), 1.0 / local_map.resolution_m, 0.0 * cell)
    cell = np.clip(np.nan_to_num(cell), 0.0, last)
    low = np.minimum(cell.astype(np.int64), np.maximum(last - 1, 0))
    part = cell - low
    slope = np.zeros(cell.shape)
    for corner in range(8):
        bit = np.array([corner >> 2 & 1, corner >> 1 & 1, corner & 1])
        value = field[tuple(np.minimum(low + bit, last).T)]
        weight = np.where(bit == 1, part, 1.0 - part)
        for axis in range(3):
            across = np.prod(np.delete(weight, axis, axis=1), axis=1)
            slope[:, axis] += np.where(bit[axis] == 1, value, -value) * across
    return np.asarray(slope * reach)


def _field(local_map: LocalMap, radius_m: float, unknown: Unknown) -> Array32:
    if not 0.0 < radius_m < math.inf:
        raise InputError(f"{radius_m} m", field="radius_m", valid="above 0")
    if unknown not in ("free", "occupied"):
        raise InputError(repr(unknown), field="unknown", valid="free, occupied")
    return _chosen(local_map, unknown)


def _chosen(local_map: LocalMap, unknown: Unknown) -> Array32:
    field = local_map.distance_m if unknown == "free" else local_map.unknown_distance_m
    if not field.size and local_map.state.size:
        raise InputError("without the distance to unknown space", field="local_map", valid="unknown: free")
    return field


def _cells(local_map: LocalMap, points_odom: Array) -> Array:
    """odom m -> cells from the map's corner, not rounded; (3,) is one point, NaN what is no place."""
    points = np.asarray(points_odom, np.float64).reshape(-1, 3)
    points = np.where(np.abs(points) < _FARTHEST_M, points, np.nan)
    cells: Array = np.ascontiguousarray((points - local_map.origin_odom) / local_map.resolution_m)
    return cells


@njit(cache=True, nogil=True)
def _segments_free(field, a, b, limits, free):  # type: ignore[no-untyped-def]
    """`limits`: radius, m; edge of a cell, m; whether what is beyond the field is free."""
    radius_m, cell_m, beyond = limits
    nx, ny, nz = field.shape
    for n in range(a.shape[0]):
        p, q = (a[n, 0], a[n, 1], a[n, 2]), (b[n, 0], b[n, 1], b[n, 2])
        way = (q[0] - p[0], q[1] - p[1], q[2] - p[2])
        if not np.isfinite(way[0] + way[1] + way[2]):
            free[n] = False
            continue
        low, high = min(p[0], q[0], p[1], q[1], p[2], q[2]), max(p[0] - nx, q[0] - nx, p[1] - ny, q[1] - ny)
        if low >= 0.0 and max(high, p[2] - nz, q[2] - nz) < 0.0:
            free[n] = _part_free(field, p, way, (0.0, 1.0), (radius_m, cell_m))
        elif beyond:
            part = _part_inside(p, way, field.shape)
            free[n] = part[0] > part[1] or _part_free(field, p, way, part, (radius_m, cell_m))
        else:
            free[n] = False


@njit(cache=True, nogil=True)
def _part_inside(p, way, shape):  # type: ignore[no-untyped-def]
    """Part (from, to) of the way inside the field, which ends where it reaches an upper face; from > to: none."""
    t0, t1 = 0.0, 1.0
    for axis in range(3):
        if way[axis] == 0.0:
            if p[axis] < 0.0 or p[axis] >= shape[axis]:
                return 1.0, 0.0
            continue
        low, high = (0.0 - p[axis]) / way[axis], (shape[axis] - p[axis]) / way[axis]
        t0, t1 = max(t0, min(low, high)), min(t1, max(low, high))
    return t0, t1


@njit(cache=True, nogil=True)
def _part_free(field, p, way, part, units):  # type: ignore[no-untyped-def]
    """From the cell at part[0] of the way on: the plane that is crossed next decides on the next cell."""
    radius, per_m = np.float32(units[0]), 1.0 / units[1]
    per_cell = 1.0 / max(math.sqrt(way[0] * way[0] + way[1] * way[1] + way[2] * way[2]), 1e-9)
    pace = (_inverse(way[0]), _inverse(way[1]), _inverse(way[2]))
    t, last = part
    i, j, k = _cell(p, way, t, field.shape)
    while 0 <= i < field.shape[0] and 0 <= j < field.shape[1] and 0 <= k < field.shape[2]:
        distance = field[i, j, k]
        if distance < radius:
            return False
        jump = (distance - radius) * per_m - _LOSS
        if jump > 0.5:
            t += jump * per_cell
            if t >= last:
                return True
            i, j, k = _cell(p, way, t, field.shape)
            continue
        tx, ty, tz = _crossing(p[0], pace[0], i), _crossing(p[1], pace[1], j), _crossing(p[2], pace[2], k)
        t = min(tx, ty, tz)
        if t > last:
            return True
        if tx == t:
            i += 1 if way[0] > 0.0 else -1
        elif ty == t:
            j += 1 if way[1] > 0.0 else -1
        else:
            k += 1 if way[2] > 0.0 else -1
    return True  # it left the field where the part ends


@njit(cache=True, nogil=True)
def _cell(p, way, t, shape):  # type: ignore[no-untyped-def]
    """Cell at part t of the way; rounding does not leave the field."""
    i = min(max(math.floor(p[0] + t * way[0]), 0), shape[0] - 1)
    j = min(max(math.floor(p[1] + t * way[1]), 0), shape[1] - 1)
    k = min(max(math.floor(p[2] + t * way[2]), 0), shape[2] - 1)
    return i, j, k


@njit(cache=True, nogil=True)
def _inverse(way):  # type: ignore[no-untyped-def]
    return 1.0 / way if way != 0.0 else 0.0


@njit(cache=True, nogil=True)
def _crossing(p, pace, i):  # type: ignore[no-untyped-def]
    """Part of the way at which it leaves cell i along one axis."""
    if pace > 0.0:
        return (i + 1 - p) * pace
    return (i - p) * pace if pace < 0.0 else math.inf
