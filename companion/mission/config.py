"""Settings of the mission executor."""

from __future__ import annotations

from typing import Annotated

import msgspec

Seconds = Annotated[float, msgspec.Meta(gt=0)]


class MissionConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """How long the mission waits, and how often it asks."""

    ready_timeout_s: Seconds = 60.0
    """Vehicle, odometry and guards must be ready within this time."""
    odometry_fresh_s: Seconds = 0.3
    """Older odometry does not count as ready."""
    command_retry_s: Seconds = 1.0
    """Time until a refused command is sent again."""
    command_answer_s: Seconds = 3.0
    """Time until a command that changed nothing is sent again; the autopilot node repeats for 2 s itself."""
    command_attempts: Annotated[int, msgspec.Meta(ge=1, le=20)] = 6
    """Commands of one kind before giving up."""
    timeout_factor: Annotated[float, msgspec.Meta(ge=1)] = 4.0
    """A step without timeout_s may take this many times its dry-run time ..."""
    timeout_extra_s: Seconds = 30.0
    """... plus this."""
    progress_m: Annotated[float, msgspec.Meta(gt=0)] = 1.0
    """Staying within this distance for planner_stuck.after_s counts as stuck."""
    leg_m: Annotated[float, msgspec.Meta(gt=0, le=1000)] = 10.0
    """Longer survey lanes are split, so that each goal takes the newest map correction."""
    lookahead_goals: Annotated[int, msgspec.Meta(ge=0, le=20)] = 3
    """Goals that follow, sent along for looking ahead."""
    settle_speed_m_s: Annotated[float, msgspec.Meta(gt=0)] = 0.3
    """Slower than this counts as stopped before landing."""
    settle_timeout_s: Seconds = 6.0
    """Lands after this time even if it never stops ..."""
    place_timeout_s: Seconds = 20.0
    """... unless it is on the way to a place where the column below is known free: then after this time."""
    hold_s: Seconds = 20.0
    """on_fail hold: time for the pilot to take over before it lands."""
    land_timeout_s: Seconds = 90.0
    """Not on the ground and disarmed by then: the mission gives up."""
