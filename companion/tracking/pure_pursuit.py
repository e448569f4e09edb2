"""Pure pursuit by preview: what the path asks for a reaction time ahead, by arc length.

The classic carrot (Coulter 1992) is chased in a straight line and cuts corners. Here the
lookahead point gives tangent, speed and acceleration, and the place to be is the nearest
point of the path.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import msgspec
import numpy as np

from companion.core.messages import Array


class PursuitConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """How far to look ahead."""

    reaction_s: Annotated[float, msgspec.Meta(ge=0)] = 0.15
    """Lag of the vehicle behind a velocity demand."""
    least_ahead_m: Annotated[float, msgspec.Meta(gt=0)] = 0.15
    """Looked ahead at least: a path that starts with speed 0 must be left, one that ends be met."""
    slow_m_s: Annotated[float, msgspec.Meta(gt=0)] = 0.5
    """Below this speed the position demand moves ahead, too, up to least_ahead_m, and the
    acceleration demand fades."""
    back_m: Annotated[float, msgspec.Meta(ge=0)] = 1.0
    """The nearest point is looked for this far back ..."""
    forth_m: Annotated[float, msgspec.Meta(gt=0)] = 4.0
    """... and this far ahead of the last one."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Preview:
    """What to do at one instant; all in the path's frame."""

    s_m: float  # arc length of the nearest point
    p: Array  # place to be, (3,)
    v: Array  # (3,), as planned
    a: Array  # (3,)
    error: Array  # nearest point minus vehicle, (3,)
    speed: float  # of the profile, m/s


class Pursuit:
    """Follows one path (N, 3) with speeds (N,); `accel_limit` bounds the feed-forward.

    >>> pursuit = Pursuit(path, speed, accel_limit=3.0, config=PursuitConfig())
    >>> preview = pursuit.preview(p, v)
    """

    def __init__(self, path: Array, speed: Array, *, accel_limit: float, config: PursuitConfig) -> None:
        self.config, self.path, self.speed = config, path, speed
        steps = np.linalg.norm(np.diff(path, axis=0), axis=1)
        self.along = np.concatenate([[0.0], np.cumsum(steps)])
        self.length_m = float(self.along[-1])
        self._s: float | None = None  # nearest so far; None: not looked for yet
        self._tangent, self._turn = np.zeros_like(path), np.zeros_like(path)  # unit; 1/m
        self._along = np.zeros(len(path))  # v dv/ds, m/s2
        self._accel_limit = accel_limit
        if self.length_m > 1e-6:
            self._tangent = _unit(np.gradient(path, axis=0))
            self._turn = np.gradient(self._tangent, self.along, axis=0)
            self._along = np.gradient(0.5 * speed**2, self.along)

    def preview(self, p: Array, v: Array) -> Preview:
        """Demand for a vehicle at `p` with velocity `v` (3,)."""
        config = self.config
        s = self._s = self._nearest(p)
        speed = float(np.interp(s, self.along, self.speed))
        ahead = max(float(np.linalg.norm(v)) * config.reaction_s, config.least_ahead_m)
        seen = s + ahead
        lead = config.least_ahead_m * max(1.0 - speed / config.slow_m_s, 0.0)
        planned = float(np.interp(seen, self.along, self.speed))
        tangent = _unit(self.at(self._tangent, seen))
        return Preview(
            s_m=s,
            p=self.at(self.path, s + lead),
            v=planned * tangent,
            a=self._feed_forward(seen, tangent, planned, float(v @ tangent)),
            error=self.at(self.path, s) - p,
            speed=speed,
        )

    def _feed_forward(self, s: float, tangent: Array, planned: float, actual: float) -> Array:
        """v dv/ds along the tangent plus v^2 dT/ds across it, for a vehicle at `actual` speed.

        One that is slower than planned needs less braking and turning, none when it stands.
        """
        share = min(max(actual / max(planned, self.config.slow_m_s), 0.0), 1.0) ** 2
        along = float(np.interp(s, self.along, self._along))
        demand = along * (1.0 if along > 0.0 else share) * tangent + share * planned**2 * self.at(self._turn, s)
        size = float(np.linalg.norm(demand))
        bounded: Array = demand * min(1.0, self._accel_limit / max(size, 1e-9))
        return bounded

    def at(self, rows: Array, s: float) -> Array:
        """Row (3,) of a table (N, 3) at an arc length, between the ends."""
        return np.array([np.interp(s, self.along, rows[:, k]) for k in range(3)])

    def heading_ahead(self, p: Array, *, look_m: float, least_m: float) -> float | None:
        """Direction from `p` to the path `look_m` ahead; None: less than `least_m` away on the plan."""
        way = self.at(self.path, (self._s or 0.0) + look_m) - p
        return float(np.arctan2(way[1], way[0])) if float(np.hypot(way[0], way[1])) >= least_m else None

    def _nearest(self, p: Array) -> float:
        """Arc length of the nearest point, within a window around the last one if there was one."""
        first, last = 0, len(self.path) - 1
        if self._s is not None:
            first = max(int(np.searchsorted(self.along, self._s - self.config.back_m, side="right")) - 1, 0)
            last = int(np.searchsorted(self.along, self._s + self.config.forth_m))
        a = self.path[first : last + 1]
        if len(a) < 2:
            return min(self._s or 0.0, self.length_m)
        way = np.diff(a, axis=0)
        squared = np.maximum(np.sum(way * way, axis=1), 1e-18)
        part = np.clip(np.sum((p - a[:-1]) * way, axis=1) / squared, 0.0, 1.0)
        gap = np.sum((a[:-1] + part[:, None] * way - p) ** 2, axis=1)
        k = int(np.argmin(gap))
        return float(self.along[first + k] + part[k] * np.sqrt(squared[k]))


def _unit(rows: Array) -> Array:
    unit: Array = rows / np.maximum(np.linalg.norm(rows, axis=-1, keepdims=True), 1e-9)
    return unit
