"""How fast to go where: curvature, nearness, climb, acceleration, and a stop in known-free space."""

from __future__ import annotations

import math
from typing import Annotated

import msgspec
import numpy as np

from companion.core.messages import Array, Limits, LocalMap
from companion.planning.grid import first_unknown

Share = Annotated[float, msgspec.Meta(gt=0, le=1)]
Positive = Annotated[float, msgspec.Meta(gt=0)]
_BEND_POINTS = 3  # curvature is taken over so many points to each side


class SpeedConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """How the limits of a goal become speeds along a path."""

    spacing_m: Positive = 0.1
    """Distance between samples of a trajectory."""
    along_share: Share = 0.7
    """Share of the acceleration limit for speeding up and slowing down."""
    lateral_share: Share = 0.6
    """Share of the acceleration limit for curves."""
    near_speed_m_s: Positive = 0.6
    """Speed with the hull touching the map margin ..."""
    near_gain_per_s: Positive = 4.0
    """... plus this much per metre of clearance beyond it."""
    near_margin_m: Annotated[float, msgspec.Meta(ge=0)] = 0.1
    """Clearance of the hull at which near_speed_m_s holds."""
    approach_gain_per_s: Positive = 1.5
    """Speed per metre left before a stop, at the end."""
    stop_margin_m: Annotated[float, msgspec.Meta(ge=0)] = 0.2
    """The stop lies this far before the first point that is not known free."""
    unknown_share: Annotated[float, msgspec.Meta(ge=0, lt=1)] = 0.03
    """Share of unknown cells around a known-free point, outside the hull: unseen single cells."""


def known_free_m(points: Array, local_map: LocalMap, config: SpeedConfig, radii_m: tuple[float, float]) -> float:
    """Arc length of evenly spaced `points` (N, 3) until space ahead is not known free; inf: all is.

    `radii_m` = (hull + clearance, hull): see `first_unknown`.
    """
    if len(points) < 2:
        return math.inf
    ways = np.gradient(points, axis=0)
    ways /= np.maximum(np.linalg.norm(ways, axis=1, keepdims=True), 1e-9)
    cell = local_map.resolution_m
    cells = np.ascontiguousarray((points - local_map.origin_odom) / cell)
    radii = (radii_m[0] / cell, radii_m[1] / cell)
    index = int(first_unknown(local_map.state, cells, ways, radii, config.unknown_share))
    return math.inf if index == len(points) else index * spacing_of(points)


def speed_profile(
    points: Array,
    limits: Limits,
    config: SpeedConfig,
    *,
    clearance_m: Array,
    start_speed: float,
    stop_m: float = math.inf,
) -> Array:
    """Speeds (N,) m/s at evenly spaced `points` (N, 3); the last is 0.

    `clearance_m` (N,) is the distance from the hull to obstacles. The speed is 0 from arc
    length `stop_m` on. A `start_speed` from which this cannot be met is braked with the whole
    acceleration limit.
    """
    count, step = len(points), spacing_of(points)
    s = step * np.arange(count)
    end_m = max(min(stop_m, float(s[-1])), 0.0)
    cap = np.minimum(_by_shape(points, limits, config), _by_nearness(clearance_m, config))
    left = np.maximum(end_m - s, 0.0)
    cap = np.minimum(cap, np.minimum(config.approach_gain_per_s * left, limits.speed))
    gain = 2.0 * config.along_share * limits.accel
    squared = np.minimum(cap**2, gain * left)
    squared = np.minimum.accumulate((squared + gain * s)[::-1])[::-1] - gain * s  # braking in time
    reach = np.minimum(squared - gain * s, start_speed**2)
    squared = np.minimum.accumulate(reach) + gain * s  # speeding up from the start
    squared = np.maximum(squared, start_speed**2 - 2.0 * limits.accel * s)
    speeds: Array = np.sqrt(np.maximum(squared, 0.0))
    return speeds


def spacing_of(points: Array) -> float:
    """Distance between the first two of evenly spaced points, m."""
    return float(np.linalg.norm(points[1] - points[0])) if len(points) > 1 else 0.0


def _by_nearness(clearance_m: Array, config: SpeedConfig) -> Array:
    beyond = np.maximum(clearance_m - config.near_margin_m, 0.0)
    return config.near_speed_m_s + config.near_gain_per_s * beyond


def curvature(points: Array) -> Array:
    """1/m (N,) at evenly spaced points, over a few points to both sides."""
    bend = np.zeros(len(points))
    m = min(_BEND_POINTS, (len(points) - 1) // 2)
    if m == 0:
        return bend
    before, after = points[m:-m] - points[: -2 * m], points[2 * m :] - points[m:-m]
    lengths = np.linalg.norm(before, axis=1), np.linalg.norm(after, axis=1)
    turn = after / np.maximum(lengths[1], 1e-9)[:, None] - before / np.maximum(lengths[0], 1e-9)[:, None]
    bend[m:-m] = np.linalg.norm(turn, axis=1) / np.maximum(0.5 * (lengths[0] + lengths[1]), 1e-9)
    return bend


def strain(points: Array, speeds: Array, accel: float) -> float:
    """Largest lateral acceleration over the limit; above 1 no vehicle can follow at these speeds."""
    return float(np.max(speeds**2 * curvature(points))) / accel


def _by_shape(points: Array, limits: Limits, config: SpeedConfig) -> Array:
    """Speed, climb, and sqrt(lateral acceleration / curvature)."""
    if len(points) < 3:
        return np.full(len(points), min(limits.speed, limits.climb))
    way = np.gradient(points, axis=0)
    steep = np.abs(way[:, 2]) / np.maximum(np.linalg.norm(way, axis=1), 1e-9)
    curve = np.sqrt(config.lateral_share * limits.accel / np.maximum(curvature(points), 1e-6))
    climb = limits.climb / np.maximum(steep, 1e-6)
    speeds: Array = np.minimum(np.minimum(curve, climb), limits.speed)
    return speeds
