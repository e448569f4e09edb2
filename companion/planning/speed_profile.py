"""How fast to go where: shape of the way, nearness, acceleration, jerk, and a stop in known-free space."""

from __future__ import annotations

import math
from typing import Annotated

import msgspec
import numpy as np

from companion.core.messages import Array, Limits, LocalMap
from companion.planning.bends import by_shape, curvature, spacing_of
from companion.planning.grid import first_unknown
from companion.planning.jerk import jerk_limited

Share = Annotated[float, msgspec.Meta(gt=0, le=1)]
Positive = Annotated[float, msgspec.Meta(gt=0)]
_HARSHER = (1.0, 2.0, 4.0, 8.0)  # times the jerk limit, for a start from which nothing less can be met


class SpeedConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """How the limits of a goal become speeds along a path."""

    spacing_m: Positive = 0.1
    """Distance between samples of a trajectory."""
    along_share: Share = 0.7
    """Share of the acceleration limit for speeding up and slowing down."""
    lateral_share: Share = 0.6
    """Share of the acceleration limit for curves."""
    along_jerk_share: Share = 0.7
    """Share of the jerk limit for changing the acceleration along the way."""
    across_jerk_share: Share = 0.6
    """Share of the jerk limit for going into bends and out of them."""
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
    start: tuple[float, float],
    stop_m: float = math.inf,
) -> Array:
    """Speeds (N,) m/s at evenly spaced `points` (N, 3); the last is 0.

    `clearance_m` (N,) is the distance from the hull to obstacles. The speed is 0 from arc length `stop_m` on. `start` =
    (speed m/s, acceleration along the way m/s2) at the first point. Where that leaves no way to meet what comes with
    the jerk allowed, up to eight times as much is taken; where that is not enough, it is braked with the whole
    acceleration limit at once. With an infinite jerk limit it is braked as late as can be.
    """
    count, step = len(points), spacing_of(points)
    s = step * np.arange(count)
    end_m = max(min(stop_m, float(s[-1])), 0.0)
    accel = config.along_share * limits.accel
    across = config.lateral_share * limits.accel, config.across_jerk_share * limits.jerk
    cap = np.minimum(by_shape(points, limits, along=accel, across=across), _by_nearness(clearance_m, config))
    left = np.maximum(end_m - s, 0.0)
    cap = np.minimum(cap, config.approach_gain_per_s * left)
    squared = np.minimum(cap**2, 2.0 * accel * left)
    if step > 0.0:
        squared = _ramped(squared, step, start, accel=accel, jerk=config.along_jerk_share * limits.jerk)
    squared = np.maximum(squared, start[0] ** 2 - 2.0 * limits.accel * s)
    speeds: Array = np.sqrt(np.maximum(squared, 0.0))
    return speeds


def _ramped(caps: Array, step_m: float, start: tuple[float, float], *, accel: float, jerk: float) -> Array:
    """Squared speeds (N,) below the caps (N,) that speed up, slow down, and change between the two as allowed."""
    for harsher in _HARSHER:
        squared, met = jerk_limited(caps, step_m, along=(accel, harsher * jerk), start=start)
        if met:
            break
    return squared


def _by_nearness(clearance_m: Array, config: SpeedConfig) -> Array:
    beyond = np.maximum(clearance_m - config.near_margin_m, 0.0)
    return config.near_speed_m_s + config.near_gain_per_s * beyond


def strain(points: Array, speeds: Array, accel: float) -> float:
    """Largest lateral acceleration over the limit; above 1 no vehicle can follow at these speeds."""
    return float(np.max(speeds**2 * curvature(points))) / accel
