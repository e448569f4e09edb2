"""Flies the legs of one step: which goal is next, and what is wrong with the present one."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from companion.core.correction import Correction
from companion.core.geometry import wrap_angle
from companion.core.messages import PROVEN, Array, Goal, Limits, PlanStatus, freeze
from companion.mission.placing import Places
from companion.mission.route import Leg
from companion.mission.schema import AnyStep


@dataclass(slots=True)
class Run:
    """The goals being flown, and how it goes."""

    legs: tuple[Leg, ...]
    places: Places
    step: AnyStep
    deadline_ns: int
    index: int = 0
    reached: int = 0
    anchor_odom: Array = field(default_factory=lambda: np.zeros(3))
    anchor_ns: int = 0  # since when the vehicle is near the anchor
    blocked_ns: int | None = None  # since when the planner finds no way

    def goal(self, now_ns: int, goal_id: int, correction: Correction, limits: Limits, *, lookahead: int) -> Goal:
        """The present leg as a goal in odom, by the newest correction."""
        leg = self.legs[self.index]
        following = self.legs[self.index + 1 : self.index + 1 + lookahead]
        ahead = np.array([self.places.p_map(after) for after in following]).reshape(-1, 3)
        yaw_map = self.places.yaw_map(leg.yaw, leg.frame)
        goal = Goal(
            stamp_ns=now_ns,
            id=goal_id,
            kind=leg.kind,
            p_odom=correction.to_odom(self.places.p_map(leg)),
            agl_m=leg.agl_m,
            radius_m=leg.radius_m,
            fly_through=leg.fly_through,
            next_p_odom=correction.to_odom(ahead),
            yaw=yaw_map if np.isnan(yaw_map) else wrap_angle(yaw_map - correction.yaw),
            if_blocked=leg.if_blocked,
            limits=limits,
        )
        frozen: Goal = freeze(goal)
        return frozen

    def begin_leg(self, now_ns: int, p_odom: Array) -> None:
        """Start watching for progress from here."""
        self.anchor_odom, self.anchor_ns, self.blocked_ns = p_odom, now_ns, None

    def problem(self, now_ns: int, p_odom: Array, plan: PlanStatus | None, *, stuck_s: float, progress_m: float) -> str:
        """What is wrong with the present goal; '' if nothing. `plan`: only the present goal's."""
        if plan is None or plan.state != "blocked":
            self.blocked_ns = None
        elif self.blocked_ns is None:
            self.blocked_ns = now_ns
        if float(np.linalg.norm(p_odom - self.anchor_odom)) > progress_m:
            self.anchor_odom, self.anchor_ns = p_odom, now_ns
        if self.late(now_ns):
            return "timeout"
        if plan is not None and plan.state == "blocked" and plan.reason.startswith(PROVEN):
            return f"the planner has proven: {plan.reason}"
        if self.blocked_ns is not None and now_ns - self.blocked_ns > stuck_s * 1e9:
            return f"the planner found no way for {stuck_s:g} s"
        if now_ns - self.anchor_ns > stuck_s * 1e9:
            return f"no progress for {stuck_s:g} s"
        return ""

    def late(self, now_ns: int) -> bool:
        """The whole step is over its time."""
        return now_ns > self.deadline_ns


def stop_goal(now_ns: int, goal_id: int, kind: Literal["hold", "land"], p_odom: Array, limits: Limits) -> Goal:
    """Stop in known-free space; to land, above a column that is known free."""
    goal = Goal(
        stamp_ns=now_ns,
        id=goal_id,
        kind=kind,
        p_odom=p_odom.copy(),
        agl_m=float("nan"),
        radius_m=0.5,
        fly_through=False,
        next_p_odom=np.empty((0, 3)),
        yaw=float("nan"),
        if_blocked="nearest_free",
        limits=limits,
    )
    frozen: Goal = freeze(goal)
    return frozen
