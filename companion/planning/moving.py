"""Where things that move will be is taken for blocked: planners then go round them, or brake, as before a trunk.

A track is an upright cylinder. What it sweeps over the next seconds at its present velocity is blocked all that time:
more than it needs, but no plan leans on when a walker passes.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated

import msgspec
import numpy as np

from companion.core.messages import Array, Array32, LocalMap, ObstacleTracks, freeze

NotNegative = Annotated[float, msgspec.Meta(ge=0)]


class MovingConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """How far ahead, and how thick."""

    horizon_s: NotNegative = 1.5
    """What a thing sweeps in this time is blocked; 0: where it is now."""
    margin_m: NotNegative = 0.2
    """Added to the radius seen: of a walker often one side alone is."""
    half_height_m: Annotated[float, msgspec.Meta(gt=0)] = 2.5
    """Blocked above and below the middle of what is seen of it."""
    fresh_s: Annotated[float, msgspec.Meta(gt=0)] = 0.6
    """Older tracks are forgotten."""


def with_moving(local_map: LocalMap, tracks: ObstacleTracks | None, now_ns: int, config: MovingConfig) -> LocalMap:
    """The map with the distances that hold if all that the tracks sweep from `now_ns` on is occupied; states stay.

    Distances are exact up to a cell's half, truncated as the map's. Without fresh tracks it is `local_map` itself.
    """
    if tracks is None or not len(tracks.id) or not _fresh(tracks, now_ns, config):
        return local_map
    late_s = (now_ns - tracks.stamp_ns) * 1e-9
    distance, unknown = local_map.distance_m.copy(), local_map.unknown_distance_m.copy()
    fields = (distance, unknown) if unknown.size else (distance,)
    most_m = float(distance.max())
    for p, v, radius_m in zip(tracks.position_odom, tracks.velocity_odom, tracks.radius_m, strict=True):
        here = p + late_s * v
        swept = np.stack([here, here + config.horizon_s * v])
        size_m = np.array([float(radius_m) + config.margin_m, config.half_height_m])
        for field in fields:
            _lower(field, local_map, swept, size_m, most_m)
    moved = replace(local_map, distance_m=distance, unknown_distance_m=unknown)
    freeze(moved)
    return moved


def is_crossed(
    places_odom: Array,
    tracks: ObstacleTracks | None,
    now_ns: int,
    config: MovingConfig,
    *,
    within_s: float,
    hull_m: float,
) -> bool:
    """Does something that moves come over one of the places (N, 3), as wide as the hull, in the time to come?

    In plan: whoever comes down passes all heights.
    """
    if tracks is None or not _fresh(tracks, now_ns, config):
        return False
    for p, v, radius_m in zip(tracks.position_odom, tracks.velocity_odom, tracks.radius_m, strict=True):
        away = _from_segment(places_odom[:, 0], places_odom[:, 1], np.stack([p, p + within_s * v]))
        if away.min() < hull_m + float(radius_m) + config.margin_m:
            return True
    return False


def _fresh(tracks: ObstacleTracks, now_ns: int, config: MovingConfig) -> bool:
    return abs(now_ns - tracks.stamp_ns) <= config.fresh_s * 1e9


def _lower(field: Array32, local_map: LocalMap, swept: Array, size_m: Array, most_m: float) -> None:
    """A field (X, Y, Z) up to `most_m`, in place, where a cylinder going from swept[0] to swept[1] (2, 3) is nearer.

    `size_m` is its radius and half its height.
    """
    cell, reach = local_map.resolution_m, size_m[[0, 0, 1]] + most_m
    low = np.floor((swept.min(axis=0) - reach - local_map.origin_odom) / cell).astype(int)
    high = np.ceil((swept.max(axis=0) + reach - local_map.origin_odom) / cell).astype(int)
    low, high = np.clip(low, 0, field.shape), np.clip(high, 0, field.shape)
    x, y, z = (local_map.origin_odom[k] + (np.arange(low[k], high[k]) + 0.5) * cell for k in range(3))
    plan = np.maximum(_from_segment(x[:, None], y[None, :], swept) - size_m[0], 0.0)
    beside = np.maximum(np.abs(z - 0.5 * (swept[0, 2] + swept[1, 2])) - size_m[1], 0.0)
    part = tuple(slice(a, b) for a, b in zip(low, high, strict=True))
    np.minimum(field[part], np.hypot(plan[:, :, None], beside), out=field[part], casting="same_kind")


def _from_segment(x: Array, y: Array, ends: Array) -> Array:
    """Distance in plan of places x, y, whose shapes go together, to the segment between two ends (2, 3)."""
    way = ends[1, :2] - ends[0, :2]
    dx, dy = x - ends[0, 0], y - ends[0, 1]
    t = np.clip((dx * way[0] + dy * way[1]) / max(float(way @ way), 1e-9), 0.0, 1.0)
    distance: Array = np.hypot(dx - t * way[0], dy - t * way[1])
    return distance
