"""The textbook's pure pursuit: chase a carrot on the path, a lookahead distance away.

Source: R. C. Coulter, "Implementation of the Pure Pursuit Path Tracking Algorithm", CMU-RI-TR-92-01, 1992:
the arc from the vehicle to the carrot that leaves along the vehicle's way has the curvature 2 sin(alpha) / L.
"""

from __future__ import annotations

from typing import Annotated

import msgspec
import numpy as np

from companion.core.messages import Array
from companion.tracking.demand import Demand, across
from companion.tracking.path import PathPoint, TrackedPath

NotNegative = Annotated[float, msgspec.Meta(ge=0)]
Positive = Annotated[float, msgspec.Meta(gt=0)]
_STEP_M = 0.05  # of the search for the carrot


class PursuitConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The lookahead distance: a time at the present speed, within two bounds."""

    lookahead_s: NotNegative = 0.7
    """Time to the carrot."""
    least_m: Positive = 0.5
    """Nearest carrot."""
    most_m: Positive = 6.0
    """Farthest carrot."""
    end_gain_per_s: Positive = 1.0
    """Speed per metre left once the carrot is the path's end."""


def pure_pursuit(path: TrackedPath, here: PathPoint, p: Array, v: Array, config: PursuitConfig) -> Demand:
    """Straight to the carrot at the speed planned there, turning on the arc that leads to it."""
    speed = float(np.linalg.norm(v))
    distance_m = min(max(speed * config.lookahead_s, config.least_m), config.most_m)
    carrot = path.at(carrot_m(path, here.s_m, p, distance_m=distance_m))
    way = carrot.p - p
    gap = float(np.linalg.norm(way))
    wished = carrot.speed if carrot.s_m < path.length_m else min(here.speed, config.end_gain_per_s * gap)
    return Demand(here=here, place=here.p, v=wished * way / max(gap, 1e-9), a=speed**2 * arc_curvature(way, v))


def carrot_m(path: TrackedPath, s_m: float, p: Array, *, distance_m: float) -> float:
    """Arc length, from `s_m` on, of the first place that is `distance_m` away from `p` (3,); the end if none is."""
    s = s_m
    while s < path.length_m and float(np.linalg.norm(path.at(s).p - p)) < distance_m:
        s += _STEP_M
    return min(s, path.length_m)


def arc_curvature(way: Array, heading: Array) -> Array:
    """Curvature vector (3,), 1/m, of the arc that leaves along `heading` (3,) and leads along `way` (3,) m.

    Its norm is 2 sin(alpha) / L with the angle alpha between them and L the length of `way`.
    """
    unit = heading / max(float(np.linalg.norm(heading)), 1e-9)
    curvature: Array = 2.0 * across(way, unit) / max(float(way @ way), 1e-9)
    return curvature
