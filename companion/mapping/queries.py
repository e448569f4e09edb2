"""Questions to the whole map: a box of states, and rays."""

from __future__ import annotations

import math
from typing import Literal, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from companion.core.errors import InputError
from companion.core.messages import Array
from companion.mapping.block_hash import EMPTY, slot_of
from companion.mapping.rays import BLOCK
from companion.mapping.sensor_model import UNKNOWN
from companion.mapping.voxel_map import FREE_CELL, OCCUPIED_CELL, UNKNOWN_CELL, VoxelMap

_FARTHEST_M = 1e5  # as the map has it
_MOST_CELLS = 1 << 30
_LONGEST_M = 1e4  # of a ray


class RayHits(NamedTuple):
    """Where rays ended. `states`: 2 an occupied voxel, 0 the first unknown one, 1 neither within the range."""

    hits: NDArray[np.bool_]  # (N,), an occupied voxel
    points_odom: Array  # where the ray enters that voxel, else its end, m, (N, 3)
    ranges_m: Array  # the same as a distance, (N,)
    states: NDArray[np.uint8]  # (N,)


def box(voxels: VoxelMap, low_odom: Array, high_odom: Array) -> tuple[NDArray[np.uint8], Array]:
    """States (X, Y, Z) of every voxel that the box from `low_odom` to `high_odom` (3,), m, overlaps, and its corner.

    0 unknown, 1 free, 2 occupied; the corner (3,) is that of voxel (0, 0, 0), m.
    InputError if the box is no box, or has more than 2^30 voxels.
    """
    low, high = (np.asarray(end, np.float64) / voxels.resolution_m for end in (low_odom, high_odom))
    if not np.all((low < high) & (np.abs(low) < _FARTHEST_M / voxels.resolution_m)):
        raise InputError(f"{list(low_odom)} to {list(high_odom)} is no box", field="low_odom", valid="below high_odom")
    first, last = np.floor(low).astype(np.int64), np.ceil(np.minimum(high, 2**40)).astype(np.int64)
    corner = first // BLOCK
    shape = BLOCK * (-(-last // BLOCK) - corner)
    if math.prod(int(n) for n in shape) > _MOST_CELLS:
        raise InputError(f"{shape.tolist()} voxels are too many", field="high_odom", valid=f"up to {_MOST_CELLS}")
    states = np.empty(tuple(shape), np.uint8)
    voxels.window(corner, states)
    inside = tuple(slice(a, b) for a, b in zip(first - BLOCK * corner, last - BLOCK * corner, strict=True))
    return states[inside].copy(), np.asarray(first * voxels.resolution_m)


def raycast(
    voxels: VoxelMap,
    origins_odom: Array,
    directions_odom: Array,
    max_range_m: float,
    *,
    unknown: Literal["pass", "stop"] = "pass",
) -> RayHits:
    """Follow rays from `origins_odom` (N, 3), m, along `directions_odom` (N, 3), of any length, up to `max_range_m`.

    Each ends at the first occupied voxel and, with "stop", at the first unknown one. Every voxel is
    visited (Amanatides and Woo 1987), but those of blocks that are not there, which are unknown. A ray
    that is not finite, of no direction or farther out than 100 km hits nothing: its point is NaN.
    """
    origins, directions = (np.array(a, np.float64).reshape(-1, 3) for a in (origins_odom, directions_odom))
    if origins.shape != directions.shape:
        raise InputError(f"{len(directions)} for {len(origins)} origins", field="directions_odom", valid="one each")
    if not 0.0 < max_range_m <= _LONGEST_M:
        raise InputError(f"{max_range_m} m", field="max_range_m", valid=f"above 0, up to {_LONGEST_M:g}")
    if unknown not in ("pass", "stop"):
        raise InputError(repr(unknown), field="unknown", valid="pass, stop")
    with np.errstate(invalid="ignore", over="ignore", divide="ignore"):
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    good = np.all(np.abs(origins) < _FARTHEST_M, axis=1) & np.all(np.isfinite(directions), axis=1)
    ranges_m, states = np.full(len(origins), np.nan), np.full(len(origins), UNKNOWN_CELL, np.uint8)
    origins[~good] = directions[~good] = np.nan
    rays, limits = (origins / voxels.resolution_m, directions), (max_range_m / voxels.resolution_m, unknown == "stop")
    ends = rays[0] + rays[1] * limits[0]
    bring_back(voxels, np.concatenate([rays[0][good], ends[good]]), 1.0)
    _raycast(voxels.blocks.table, voxels.blocks.log_odds, rays, limits, (ranges_m, states))
    ranges_m *= voxels.resolution_m
    return RayHits(states == OCCUPIED_CELL, origins + directions * ranges_m[:, None], ranges_m, states)


def bring_back(voxels: VoxelMap, cells: Array, margin: float) -> None:
    """Have all blocks in the store that meet the box around `cells` (N, 3) and `margin`, cells, beyond it."""
    if len(cells):
        low, high = cells.min(axis=0) - margin, cells.max(axis=0) + margin
        voxels.memory.bring_back((np.floor(low / BLOCK).astype(np.int64), np.floor(high / BLOCK).astype(np.int64) + 1))


@njit(cache=True, nogil=True)
def _raycast(table, log_odds, rays, limits, found):  # type: ignore[no-untyped-def]
    """In cells. `limits`: range, whether unknown stops; `found`: ranges, states; NaN rays stay as they are."""
    origins, ways = rays
    ranges, states = found
    for n in range(ranges.size):
        if not np.isnan(origins[n, 0]):
            p, way = (origins[n, 0], origins[n, 1], origins[n, 2]), (ways[n, 0], ways[n, 1], ways[n, 2])
            ranges[n], states[n] = _follow(table, log_odds, (p, way), limits)


@njit(cache=True, nogil=True)
def _follow(table, log_odds, ray, limits):  # type: ignore[no-untyped-def]
    """(range, state) of one ray: cell by cell, and over blocks that are not there at once."""
    keys, values = table
    p, way = ray
    most, stop = limits
    pace = (_inverse(way[0]), _inverse(way[1]), _inverse(way[2]))
    i, j, k = math.floor(p[0]), math.floor(p[1]), math.floor(p[2])
    t = 0.0
    while t <= most:
        slot = slot_of(keys, i >> 3, j >> 3, k >> 3)
        row = -1 if keys[slot] == EMPTY else values[slot]
        block = (i >> 3, j >> 3, k >> 3)
        if row < 0:
            if stop:
                return t, UNKNOWN_CELL
            t, i, j, k = _leave(p, pace, (i, j, k))
            continue
        cells = log_odds[row]
        while t <= most and i >> 3 == block[0] and j >> 3 == block[1] and k >> 3 == block[2]:
            level = cells[(i & 7) * BLOCK * BLOCK + (j & 7) * BLOCK + (k & 7)]
            if level >= 0:
                return t, OCCUPIED_CELL
            if stop and level == UNKNOWN:
                return t, UNKNOWN_CELL
            tx, ty, tz = _crossing(p[0], pace[0], i), _crossing(p[1], pace[1], j), _crossing(p[2], pace[2], k)
            t = min(tx, ty, tz)
            if tx == t:
                i += 1 if way[0] > 0.0 else -1
            elif ty == t:
                j += 1 if way[1] > 0.0 else -1
            else:
                k += 1 if way[2] > 0.0 else -1
    return most, FREE_CELL


@njit(cache=True, nogil=True)
def _leave(p, pace, cell):  # type: ignore[no-untyped-def]
    """(t, i, j, k) where the ray enters the next block: planes in the order in which single cells cross them."""
    i, j, k = cell
    tx, ty, tz = _last_crossing(p[0], pace[0], i), _last_crossing(p[1], pace[1], j), _last_crossing(p[2], pace[2], k)
    t = min(tx, ty, tz)
    if tx == t:
        return t, _over(i, pace[0]), _before(p[1], pace[1], j, t, False), _before(p[2], pace[2], k, t, False)
    if ty == t:
        return t, _before(p[0], pace[0], i, t, True), _over(j, pace[1]), _before(p[2], pace[2], k, t, False)
    return t, _before(p[0], pace[0], i, t, True), _before(p[1], pace[1], j, t, True), _over(k, pace[2])


@njit(cache=True, nogil=True)
def _last_crossing(p, pace, i):  # type: ignore[no-untyped-def]
    """Way at which the ray leaves the block of cell i along one axis."""
    return _crossing(p, pace, i | (BLOCK - 1) if pace > 0.0 else i & ~(BLOCK - 1))


@njit(cache=True, nogil=True)
def _over(i, pace):  # type: ignore[no-untyped-def]
    """First cell of the next block along one axis."""
    return (i | (BLOCK - 1)) + 1 if pace > 0.0 else (i & ~(BLOCK - 1)) - 1


@njit(cache=True, nogil=True)
def _before(p, pace, i, t, equal):  # type: ignore[no-untyped-def]
    """Cell along one axis once every plane before `t` is crossed; `equal`: and those at `t`."""
    step = 1 if pace > 0.0 else -1
    while True:
        crossing = _crossing(p, pace, i)
        if crossing > t or (crossing == t and not equal):
            return i
        i += step


@njit(cache=True, nogil=True)
def _inverse(way):  # type: ignore[no-untyped-def]
    return 1.0 / way if way != 0.0 else 0.0


@njit(cache=True, nogil=True)
def _crossing(p, pace, i):  # type: ignore[no-untyped-def]
    """Way at which the ray leaves cell i along one axis."""
    if pace > 0.0:
        return (i + 1 - p) * pace
    return (i - p) * pace if pace < 0.0 else math.inf
