"""Counts replans at which the vehicle stands although there is a way."""

from __future__ import annotations

import numpy as np

from companion.core.messages import Goal
from companion.planning.bends import spacing_of
from companion.planning.flown import SLOW_M_S, Flown
from companion.planning.polyline import length, project
from companion.planning.situation import Situation
from companion.planning.speed_profile import SpeedConfig, known_free_m

_WAY_LEFT_M = 0.3  # a way that stops sooner counts as standing
_KNOWN_M = 2.0  # so much known way ends creeping


class Standing:
    """`still` replans in a row; from `creep_after` on known space is asked for the hull alone, until more is known."""

    def __init__(self, config: SpeedConfig, *, hull_radius_m: float, creep_after: int) -> None:
        self._config, self._hull_radius_m, self._creep_after = config, hull_radius_m, creep_after
        self.still = 0

    @property
    def creeps(self) -> bool:
        """Has it stood for long?"""
        return self.still >= self._creep_after

    def count(self, flown: Flown | None, goal: Goal, now: Situation) -> None:
        """A replan with the answer `flown`; None: there is nothing to fly."""
        if flown is None:
            self.still = 0
            return
        moves = float(np.linalg.norm(now.v_odom)) >= SLOW_M_S
        if moves and not self.creeps:
            self.still = 0
        elif not moves:
            points, _ = flown.ahead_until_stop
            s, _ = project(points, now.p_odom)
            self.still = self.still + 1 if length(points) - s < _WAY_LEFT_M else self.still
        elif self._known_ahead_m(flown, goal, now) > _KNOWN_M:
            self.still = 0

    def _known_ahead_m(self, flown: Flown, goal: Goal, now: Situation) -> float:
        """Way ahead that is known free with all the clearance asked for: then creeping may end."""
        if len(flown.points) < 2:
            return 0.0
        s = project(flown.points, now.p_odom)[0]
        first = min(int(s / spacing_of(flown.points)), len(flown.points) - 1)
        ahead = flown.points[first:]
        radii_m = (self._hull_radius_m + goal.limits.clearance, self._hull_radius_m)
        return min(known_free_m(ahead, now.local_map, self._config, radii_m), length(ahead))
