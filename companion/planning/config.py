"""Settings of the planning stage."""

from __future__ import annotations

from typing import Annotated

import msgspec

from companion.planning.landing import LandingConfig
from companion.planning.moving import MovingConfig
from companion.planning.registry import PlannerSettings
from companion.planning.route import RouteConfig
from companion.planning.smooth import SmoothConfig
from companion.planning.speed_profile import SpeedConfig
from companion.planning.switch import SwitchConfig

Metres = Annotated[float, msgspec.Meta(ge=0)]
Count = Annotated[int, msgspec.Meta(ge=1)]


class PlanningConfig(PlannerSettings, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Replanning and its algorithms."""

    route: RouteConfig = RouteConfig()
    smooth: SmoothConfig = SmoothConfig()
    speed: SpeedConfig = SpeedConfig()
    landing: LandingConfig = LandingConfig()
    moving: MovingConfig = MovingConfig()
    commit_s: Annotated[float, msgspec.Meta(ge=0)] = 0.15
    """Flown before a new plan takes over: its latency and 0.1 s."""
    keep_slack_m: Metres = 0.1
    """The old route stays while it is at most this much nearer to obstacles than it was planned."""
    switch: SwitchConfig = SwitchConfig()
    most_strain: Annotated[float, msgspec.Meta(gt=0)] = 1.0
    """A new way that asks for more than this times the acceleration limit across it waits until the
    vehicle is slower."""
    turn_above_m: Metres = 0.5
    """A takeoff turns only when it has risen this far."""
    ahead_m: Metres = 6.0
    """Planned beyond a goal that is flown through."""
    ground_within_m: Metres = 1.5
    """Ground seen this near to a goal gives its height."""
    proven_after: Count = 4
    """Proofs in a row, one per map, that no way leads to the goal, until the plan is `blocked` for that reason."""
    blocked_after: Count = 5
    """Failed replans in a row until the plan is `blocked`."""
    creep_after: Count = 5
    """Replans without moving, although there is a route, until known space is asked for the hull alone."""
    stuck_after: Count = 40
    """Replans without moving until the plan is `blocked`."""
    creep_speed_m_s: Annotated[float, msgspec.Meta(gt=0)] = 0.5
    """Speed then."""
    creep_margin_m: Metres = 0.05
    """Known space beyond the hull then."""
