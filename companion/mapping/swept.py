"""Whether a sphere may move through what is known to be free: exact, on the whole map."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from companion.core.errors import InputError
from companion.core.messages import Array
from companion.mapping.block_hash import EMPTY, slot_of
from companion.mapping.queries import bring_back
from companion.mapping.rays import BLOCK
from companion.mapping.sensor_model import UNKNOWN
from companion.mapping.voxel_map import VoxelMap

_FARTHEST_M = 1e5  # as the map has it
_WIDEST_M = 100.0  # of a sphere
_ROUNDING = 1e-6  # cells
u64 = np.uint64


def known_free(voxels: VoxelMap, a_odom: Array, b_odom: Array, radius_m: float) -> NDArray[np.bool_]:
    """Whether a sphere may move from `a_odom` to `b_odom` (N, 3), m, through what is known to be free, (N,).

    True if every voxel whose box comes nearer than `radius_m` to the segment is free: exact. A
    segment that is not finite, or farther out than 100 km, is not free.
    """
    a, b = (np.array(ends, np.float64).reshape(-1, 3) for ends in (a_odom, b_odom))
    if a.shape != b.shape:
        raise InputError(f"{len(a)} begins and {len(b)} ends", field="b_odom", valid="as many of both")
    if not 0.0 < radius_m <= _WIDEST_M:
        raise InputError(f"{radius_m} m", field="radius_m", valid=f"above 0, up to {_WIDEST_M:g}")
    good = np.all(np.abs(a) < _FARTHEST_M, axis=1) & np.all(np.abs(b) < _FARTHEST_M, axis=1)
    free = np.zeros(len(a), np.bool_)
    a, b = a[good] / voxels.resolution_m, b[good] / voxels.resolution_m
    swept = np.empty(len(a), np.bool_)
    bring_back(voxels, np.concatenate([a, b]), radius_m / voxels.resolution_m + 1.0)
    _known_free(voxels.blocks.table, voxels.blocks.log_odds, (a, b - a), radius_m / voxels.resolution_m, swept)
    free[good] = swept
    return free


@njit(cache=True, nogil=True)
def _known_free(table, log_odds, segments, radius, free):  # type: ignore[no-untyped-def]
    """In cells: every block that comes near a segment is there, and its cells that do are free."""
    begins, ways = segments
    for n in range(free.size):
        p, way = (begins[n, 0], begins[n, 1], begins[n, 2]), (ways[n, 0], ways[n, 1], ways[n, 2])
        free[n] = _tube_free(table, log_odds, (p, way), radius)


@njit(cache=True, nogil=True)
def _tube_free(table, log_odds, segment, radius):  # type: ignore[no-untyped-def]
    """Blocks in slabs along x, y and z, each cut to the part of the segment that can be near."""
    keys, values = table
    p, way = segment
    for i in range(_first(p[0], way[0], (0.0, 1.0), radius), _last(p[0], way[0], (0.0, 1.0), radius) + 1):
        in_x = _cut(p[0], way[0], (0.0, 1.0), (i, radius))
        for j in range(_first(p[1], way[1], in_x, radius), _last(p[1], way[1], in_x, radius) + 1):
            in_y = _cut(p[1], way[1], in_x, (j, radius))
            for k in range(_first(p[2], way[2], in_y, radius), _last(p[2], way[2], in_y, radius) + 1):
                if (
                    _gap2(p, way, (float(BLOCK * i), float(BLOCK * j), float(BLOCK * k)), float(BLOCK))
                    >= radius * radius
                ):
                    continue
                slot = slot_of(keys, i, j, k)
                if keys[slot] == EMPTY or not _cells_free(log_odds[values[slot]], segment, (i, j, k), radius):
                    return False
    return True


@njit(cache=True, nogil=True)
def _first(p, way, part, radius):  # type: ignore[no-untyped-def]
    """First block along one axis that is near that part of the segment."""
    return math.floor((p + min(part[0] * way, part[1] * way) - radius - _ROUNDING) / BLOCK)


@njit(cache=True, nogil=True)
def _last(p, way, part, radius):  # type: ignore[no-untyped-def]
    return math.floor((p + max(part[0] * way, part[1] * way) + radius + _ROUNDING) / BLOCK)


@njit(cache=True, nogil=True)
def _cut(p, way, part, slab):  # type: ignore[no-untyped-def]
    """What of the part is within the radius of block `slab[0]` along one axis."""
    block, radius = slab
    if way == 0.0:
        return part
    low = (BLOCK * block - radius - _ROUNDING - p) / way
    high = (BLOCK * (block + 1) + radius + _ROUNDING - p) / way
    t0 = max(part[0], min(low, high))
    return t0, max(t0, min(part[1], max(low, high)))


@njit(cache=True, nogil=True)
def _cells_free(cells, segment, block, radius):  # type: ignore[no-untyped-def]
    """Whether all cells of a block that come near are free; eight at a time where all are."""
    low7, signs = u64(0x7F7F7F7F7F7F7F7F), u64(0x8080808080808080)
    p, way = segment
    words = cells.view(np.uint64)
    for w in range(words.size):
        if words[w] & ((words[w] & low7) + low7) & signs == signs:  # negative, and not -128
            continue
        x, y = float(BLOCK * block[0] + (w >> 3)), float(BLOCK * block[1] + (w & 7))
        for k in range(BLOCK):
            level = cells[BLOCK * w + k]
            if level < 0 and level != UNKNOWN:
                continue
            if _gap2(p, way, (x, y, float(BLOCK * block[2] + k)), 1.0) < radius * radius:
                return False
    return True


@njit(cache=True, nogil=True)
def _gap2(p, way, low, edge):  # type: ignore[no-untyped-def]
    """Squared distance of the segment p .. p + way to the cube at `low`.

    It is convex and piecewise quadratic along the segment: its slope is piecewise linear, with
    corners where the segment crosses a face's plane, and grows; so its zero is bracketed by these.
    """
    before, after = 0.0, 1.0
    falls, rises = _slope(p, way, 0.0, (low, edge)), _slope(p, way, 1.0, (low, edge))
    if falls >= 0.0:
        return _gap2_at(p, way, 0.0, (low, edge))
    if rises <= 0.0:
        return _gap2_at(p, way, 1.0, (low, edge))
    for axis in range(3):
        if way[axis] == 0.0:
            continue
        for side in range(2):
            t = (low[axis] + side * edge - p[axis]) / way[axis]
            if before < t < after:
                slope = _slope(p, way, t, (low, edge))
                if slope <= 0.0:
                    before, falls = t, slope
                else:
                    after, rises = t, slope
    return _gap2_at(p, way, before + (after - before) * falls / (falls - rises), (low, edge))


@njit(cache=True, nogil=True)
def _slope(p, way, t, cube):  # type: ignore[no-untyped-def]
    """Half of the slope of the squared distance along the segment."""
    low, edge = cube
    slope = 0.0
    for axis in range(3):
        x = p[axis] + t * way[axis] - low[axis]
        slope += way[axis] * (min(x, 0.0) + max(x - edge, 0.0))
    return slope


@njit(cache=True, nogil=True)
def _gap2_at(p, way, t, cube):  # type: ignore[no-untyped-def]
    low, edge = cube
    gap2 = 0.0
    for axis in range(3):
        x = p[axis] + t * way[axis] - low[axis]
        out = min(x, 0.0) + max(x - edge, 0.0)
        gap2 += out * out
    return gap2
