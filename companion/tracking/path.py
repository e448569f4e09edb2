"""A path as a tracker sees it: place, direction, bend and speed by arc length, and the nearest point."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import msgspec
import numpy as np

from companion.core.messages import Array

_SAME_WAY_M2 = 0.5  # of two places equally near, one whose direction is opposite counts as so much farther


class RegulationConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Speeds of a trajectory are lowered where it asks for more than its acceleration limit.

    What a planner sends keeps the limit, and stays as it is; nearness to obstacles is the planner's matter.
    """

    across_share: Annotated[float, msgspec.Meta(gt=0, le=1)] = 0.8
    """Share of the acceleration limit for curves."""
    along_share: Annotated[float, msgspec.Meta(gt=0, le=1)] = 0.8
    """Share of the acceleration limit for speeding up and slowing down."""
    ease_s: Annotated[float, msgspec.Meta(ge=0)] = 0.3
    """Speeding up ends and braking begins gradually over this time: no vehicle tilts at once."""


@dataclass(frozen=True, slots=True, eq=False)
class PathPoint:
    """One place of a path."""

    s_m: float  # arc length
    p: Array  # (3,)
    tangent: Array  # unit, (3,); zero on a path of one point
    turn: Array  # change of the tangent per metre, (3,), 1/m
    speed: float  # m/s
    pull: float  # v dv/ds, m/s2: acceleration along


class TrackedPath:
    """Points (N, 3), m, with speeds (N,), m/s, and an acceleration limit, m/s2.

    >>> path = TrackedPath(points, speeds, accel_limit=3.0)
    >>> path.at(path.nearest(p)).tangent
    """

    def __init__(
        self, points: Array, speeds: Array, *, accel_limit: float, regulation: RegulationConfig | None = None
    ) -> None:
        self.points, self.accel_limit = points, accel_limit
        steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
        self.along = np.concatenate([[0.0], np.cumsum(steps)])
        self.length_m = float(self.along[-1])
        tangents, turns, pulls = np.zeros_like(points), np.zeros_like(points), np.zeros(len(points))
        if self.length_m > 1e-6:
            tangents = _unit(np.gradient(points, axis=0))
            turns = np.gradient(tangents, self.along, axis=0)
            speeds = regulated(speeds, self.along, turns, accel_limit, regulation or RegulationConfig())
            pulls = np.gradient(0.5 * speeds**2, self.along)
        self.speeds = speeds
        self.top_speed = float(speeds.max())
        self._table = np.column_stack([points, tangents, turns, speeds, pulls])  # (N, 11)

    def at(self, s_m: float) -> PathPoint:
        """The place at an arc length, between the ends."""
        s = min(max(s_m, 0.0), self.length_m)
        k = min(max(int(np.searchsorted(self.along, s, side="right")) - 1, 0), max(len(self.along) - 2, 0))
        row = self._table[k]
        if len(self.along) > 1:
            share = (s - self.along[k]) / max(self.along[k + 1] - self.along[k], 1e-12)
            row = row + share * (self._table[k + 1] - row)
        return PathPoint(s, row[:3], _unit(row[3:6]), row[6:9], float(row[9]), float(row[10]))

    def nearest(
        self, p: Array, *, window_m: tuple[float, float] | None = None, direction: Array | None = None
    ) -> float:
        """Arc length of the point nearest to `p` (3,), on the whole path or between two arc lengths.

        `direction` (3,): of places about equally near the one that leads there, for a path that crosses itself.
        """
        first, last = 0, len(self.points) - 1
        if window_m is not None:
            first = max(int(np.searchsorted(self.along, window_m[0], side="right")) - 1, 0)
            last = int(np.searchsorted(self.along, window_m[1]))
        a = self.points[first : last + 1]
        if len(a) < 2:
            return min(max(window_m[0] if window_m else 0.0, 0.0), self.length_m)
        way = np.diff(a, axis=0)
        squared = np.maximum(np.sum(way * way, axis=1), 1e-18)
        part = np.clip(np.sum((p - a[:-1]) * way, axis=1) / squared, 0.0, 1.0)
        gap = np.sum((a[:-1] + part[:, None] * way - p) ** 2, axis=1)
        if direction is not None:
            gap = gap + 0.5 * _SAME_WAY_M2 * (1.0 - way @ direction / np.sqrt(squared))
        k = int(np.argmin(gap))
        return float(self.along[first + k] + part[k] * np.sqrt(squared[k]))


def regulated(speeds: Array, along: Array, turns: Array, accel_limit: float, config: RegulationConfig) -> Array:
    """Speeds (N,) at arc lengths `along` (N,), lowered to v^2 |dT/ds| and |v dv/ds| within their shares of the limit.

    Speeding up is bounded from the first point's own speed on; braking is bounded backwards from the last.
    """
    bend = np.linalg.norm(turns, axis=1)
    squared = np.minimum(speeds**2, config.across_share * accel_limit / np.maximum(bend, 1e-9))
    gain = 2.0 * config.along_share * accel_limit * along
    squared = np.minimum.accumulate((squared + gain)[::-1])[::-1] - gain
    squared = np.maximum(np.minimum.accumulate(squared - gain) + gain, 0.0)
    return np.sqrt(_eased(squared, along, config.ease_s))


def _eased(squared: Array, along: Array, ease_s: float) -> Array:
    """Squared speeds (N,), or their mean over `ease_s` of the way around where that is less: ramps get round ends."""
    half = 0.5 * ease_s * np.sqrt(squared)
    low, high = np.maximum(along - half, along[0]), np.minimum(along + half, along[-1])
    sums = np.concatenate([[0.0], np.cumsum(0.5 * (squared[1:] + squared[:-1]) * np.diff(along))])
    width = high - low
    mean = (_integral(high, along, squared, sums) - _integral(low, along, squared, sums)) / np.maximum(width, 1e-9)
    eased: Array = np.where(width > 1e-6, np.minimum(squared, mean), squared)
    return np.maximum(eased, 0.0)


def _integral(s: Array, along: Array, values: Array, sums: Array) -> Array:
    """Integral of the polyline `values` (N,) over `along` (N,) up to `s`; `sums` (N,) is that up to each vertex."""
    k = np.clip(np.searchsorted(along, s, side="right") - 1, 0, len(along) - 2)
    at_s = np.interp(s, along, values)
    whole: Array = sums[k] + 0.5 * (values[k] + at_s) * (s - along[k])
    return whole


def _unit(rows: Array) -> Array:
    unit: Array = rows / np.maximum(np.linalg.norm(rows, axis=-1, keepdims=True), 1e-9)
    return unit
