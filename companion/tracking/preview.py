"""Pure pursuit as preview: what the path asks for a reaction time ahead, by arc length.

The carrot of pure pursuit (Coulter 1992) is chased in a straight line and cuts corners. Here the
point ahead gives direction, speed and acceleration, and the place to be is the nearest point.
A vehicle that answers a velocity and its derivative with a delay T is where it should be when both
are asked for T early: T and the drag were identified on the simulated vehicle (docs/reference/tracking.md).
"""

from __future__ import annotations

from typing import Annotated

import msgspec
import numpy as np

from companion.core.messages import Array
from companion.tracking.demand import Demand, limited
from companion.tracking.path import PathPoint, TrackedPath

NotNegative = Annotated[float, msgspec.Meta(ge=0)]
Positive = Annotated[float, msgspec.Meta(gt=0)]


class PreviewConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """How far to look ahead, and what to feed forward."""

    reaction_s: NotNegative = 0.15
    """Delay of the vehicle behind velocity and acceleration demands."""
    least_ahead_m: Positive = 0.15
    """Looked ahead at least: a path that starts with speed 0 must be left, one that ends be met."""
    slow_m_s: Positive = 0.5
    """Below this planned speed the place to be moves ahead, too, up to least_ahead_m, and the acceleration fades."""
    drag_per_s: NotNegative = 0.1
    """Deceleration per speed by rotor drag in still air, fed forward: else the autopilot's integral
    carries it, and overshoots at the end."""


def preview(path: TrackedPath, here: PathPoint, v: Array, config: PreviewConfig) -> Demand:
    """Demand for a vehicle with velocity `v` (3,) m/s whose nearest point is `here`."""
    ahead_m = max(float(np.linalg.norm(v)) * config.reaction_s, config.least_ahead_m)
    seen = path.at(here.s_m + ahead_m)
    lead_m = config.least_ahead_m * max(1.0 - here.speed / config.slow_m_s, 0.0)
    return Demand(
        here=here,
        place=path.at(here.s_m + lead_m).p,
        v=seen.speed * seen.tangent,
        a=_feed_forward(path, seen, float(v @ seen.tangent), config),
    )


def _feed_forward(path: TrackedPath, seen: PathPoint, actual: float, config: PreviewConfig) -> Array:
    """v dv/ds along the tangent, v^2 dT/ds across it, and drag, for a vehicle at `actual` speed.

    One that is slower than planned needs less braking and turning, none when it stands. It is pulled on by no more
    than makes it as fast as planned ahead in half its reaction time: else it leaves its acceleration too fast.
    """
    share = min(max(actual / max(seen.speed, config.slow_m_s), 0.0), 1.0) ** 2
    missing = max(seen.speed - actual, 0.0) / max(0.5 * config.reaction_s, 1e-9)
    along = min(seen.pull, missing) if seen.pull > 0.0 else share * seen.pull
    bent: Array = along * seen.tangent + share * seen.speed**2 * seen.turn
    return limited(bent, path.accel_limit) + config.drag_per_s * seen.speed * seen.tangent
