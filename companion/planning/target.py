"""Where to aim: a goal's height above ground, and the free place nearest to a goal."""

from __future__ import annotations

import math

import numpy as np

from companion.core.messages import Array, LocalMap
from companion.planning.space import FieldSpace

_FREE_M = 0.1  # a place this near is the goal
_LITTLE_M = 0.5  # farther from the goal, and a place is still kept
_BEARINGS_RAD = tuple(math.radians(d) for d in (0, 10, -10, 20, -20, 35, -35, 50, -50, 70, -70))


def ground_below(local_map: LocalMap, p_odom: Array, *, within_m: float, fallback_z: float) -> float:
    """Median ground height seen near a place, odom z; `fallback_z` if none was."""
    cell = local_map.resolution_m
    low = np.floor((p_odom[:2] - within_m - local_map.origin_odom[:2]) / cell).astype(int)
    high = np.ceil((p_odom[:2] + within_m - local_map.origin_odom[:2]) / cell).astype(int)
    low, high = np.maximum(low, 0), np.maximum(high, 0)
    near = local_map.ground_z_odom[low[0] : high[0], low[1] : high[1]]
    seen = near[~np.isnan(near)]
    return float(np.median(seen)) if seen.size else fallback_z


def at_height(p_odom: Array, agl_m: float, local_map: LocalMap, *, within_m: float, fallback_z: float) -> Array:
    """The goal with its z from the ground under it, if a height above ground is asked for and ground was seen."""
    if math.isnan(agl_m):
        return p_odom
    z = ground_below(local_map, p_odom, within_m=within_m, fallback_z=fallback_z) + agl_m
    return p_odom if math.isnan(z) else np.array([p_odom[0], p_odom[1], z])


def place_for(
    goal: Array, space: FieldSpace, start: Array, *, within_m: float, margin_m: float, before: Array | None = None
) -> tuple[Array, bool] | None:
    """(free point to aim at, is it a substitute at the map's border); None: nothing free.

    A goal inside the map gives the nearest free point within `within_m`, or one beside the place aimed at `before`
    that is little farther: of two on opposite sides of a trunk, now one and now the other is the nearest.
    For a goal outside, the border region is searched towards it, then to both sides.
    """
    if space.contains(goal, margin_m=margin_m):
        place = _nearest_within_band(goal, space, within_m)
        if place is None:
            return None
        return place if before is None else _near_the_old(before, place, goal, space), False
    way = goal - start
    best: Array | None = None
    for bearing in _BEARINGS_RAD:
        c, s = math.cos(bearing), math.sin(bearing)
        turned = np.array([c * way[0] - s * way[1], s * way[0] + c * way[1], way[2]])
        place = space.nearest_free(_to_border(start, turned, space, margin_m), within_m=2.0)
        nearer = place is not None and (
            best is None or np.linalg.norm(goal - place) < np.linalg.norm(goal - best) - 2.0
        )
        if nearer:
            best = place
    return None if best is None else (best, True)


def _near_the_old(before: Array, place: Array, goal: Array, space: FieldSpace) -> Array:
    """The free place nearest to the one before, unless the goal itself is free or `place` is much nearer to it."""
    off = float(np.linalg.norm(place - goal))
    near = space.nearest_free(before, within_m=_LITTLE_M) if off > _FREE_M else None
    return place if near is None or float(np.linalg.norm(near - goal)) > off + _LITTLE_M else near


def _nearest_within_band(goal: Array, space: FieldSpace, within_m: float) -> Array | None:
    """The nearest free point; a goal above or below the allowed heights is first moved into them."""
    i, j = (int(n) for n in np.floor(space.to_cells(goal))[:2])
    low, high = space.heights(i, j)
    lifted = np.array([goal[0], goal[1], min(max(goal[2], low), max(low, high))])
    return space.nearest_free(lifted, within_m=within_m)


def _to_border(start: Array, way: Array, space: FieldSpace, margin_m: float) -> Array:
    """Where start + t * way leaves the map less its margin; z stays inside."""
    low, high = space.bounds
    low, high = low + margin_m, high - margin_m
    t = 1.0
    for k in range(2):
        if abs(way[k]) > 1e-9:
            t = min(t, max(((high if way[k] > 0 else low)[k] - start[k]) / way[k], 0.0))
    point: Array = np.clip(start + t * way, low, high - 1e-6)
    i, j = (int(n) for n in np.floor(space.to_cells(point))[:2])
    bottom, top = space.heights(i, j)
    point[2] = min(max(point[2], bottom), max(bottom, top))
    return point
