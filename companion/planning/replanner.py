"""Decides at each new map what to fly: keep the old way, take a new one, brake, escape, stop.

Always ends: failures are counted, and after a few the plan is `blocked` until a map brings a way.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Literal

import numpy as np

from companion.core.messages import PROVEN, Array, Goal, LocalMap
from companion.planning.aside import Aside
from companion.planning.config import PlanningConfig
from companion.planning.flown import SLOW_M_S, Commitment, Flown, braked, clear_m, commit, with_speeds
from companion.planning.polyline import cut, length, project, resample, without_repeats
from companion.planning.registry import make_planner
from companion.planning.route import Route, RouteFinder, Spaces
from companion.planning.situation import Situation
from companion.planning.smooth import smooth
from companion.planning.space import FieldSpace
from companion.planning.standing import Standing
from companion.planning.switch import as_flown, better
from companion.planning.target import at_height
from companion.planning.verify import first_hit_m

State = Literal["idle", "flying", "reached", "blocked"]


class Replanner:
    """Feed it goals and situations; `flown` is what to fly."""

    def __init__(self, config: PlanningConfig, *, hull_radius_m: float, seed: int) -> None:
        self.config, self.hull_radius_m, self._seed = config, hull_radius_m, seed
        planner = make_planner(config.route.planner, config)
        self._finder = RouteFinder(config.route, planner, hull_radius_m=hull_radius_m)
        self.flown: Flown | None = None
        self.goal: Goal | None = None
        self.reached = False
        self._standing = Standing(config.speed, hull_radius_m=hull_radius_m, creep_after=config.creep_after)
        self.iterations = self._fails = self._replans = self._proofs = 0
        self.checked = self.refused = 0  # ways traversed before they were published, and of them braked on
        self.whys: list[tuple[str, str]] = []  # what was decided, because of what, since the last look
        self._target: Array | None = None  # where the route leads; None: none yet
        self._goal_odom = np.zeros(3)  # the goal with its height from the ground
        self._planned_radius_m = hull_radius_m
        self._at_border = self._substitute = False
        self._begun = False  # the present goal was planned for
        self._still: LocalMap | None = None  # the newest map, without what moves
        self._aside: Aside | None = None  # of the place to hold

    def take_goal(self, goal: Goal) -> None:
        """A new goal; the way being flown stays until the next `update`."""
        self.goal, self.reached, self._begun, self._aside = goal, False, False, None
        self._fails = self._standing.still = self._proofs = 0
        self._target = None

    @property
    def state(self) -> State:
        """For PLAN."""
        if self.goal is None:
            return "idle"
        if self.reached:
            return "reached"
        return "blocked" if self.reason else "flying"

    @property
    def reason(self) -> str:
        """Why the plan is blocked; '' if it is not."""
        if self._proofs >= self.config.proven_after:
            return f"{PROVEN}: no free cells lead to the goal"
        if self._fails >= self.config.blocked_after:
            return f"no route found {self._fails} times in a row"
        if self._standing.still >= self.config.stuck_after:
            return "standing although there is a route"
        return ""

    def look(self, p_odom: Array, v_odom: Array) -> None:
        """Notice whether the goal is reached."""
        if self.goal is None or self._target is None or self.flown is None or self.reached:
            return
        if self.goal.kind == "hold":
            self.reached = float(np.linalg.norm(v_odom)) < SLOW_M_S
            return
        to_target = float(np.linalg.norm(p_odom - self._target))
        to_goal = float(np.linalg.norm(p_odom - self._goal_odom))
        if self._at_border:
            self.reached = to_goal <= self.goal.radius_m
        elif self._substitute:
            self.reached = to_goal <= self.goal.radius_m or to_target <= min(self.goal.radius_m, 0.3)
        else:
            self.reached = to_target <= self.goal.radius_m or self._passed(p_odom)

    def _passed(self, p_odom: Array) -> bool:
        """Flown through: the vehicle is beyond the goal on its way."""
        if self.goal is None or self.flown is None or not self.goal.fly_through:
            return False
        s, off = project(self.flown.points, p_odom)
        return off < self.goal.radius_m and s > self.flown.reach_m + 0.05 < length(self.flown.points)

    def update(self, now: Situation) -> Flown:
        """Replan; the answer is also kept as `flown`."""
        assert self.goal is not None
        self._replans += 1
        self._still = now.still_map
        if self._begun:
            self.look(now.p_odom, now.v_odom)
        first = self.flown is None
        fly = {"takeoff": self._take_off, "fly": self._fly, "hold": self._hold}[self.goal.kind]
        self.flown = self._checked(fly(self.goal, now), now)
        self._begun = True
        self._standing.count(None if self.reached or first else self.flown, self.goal, now)
        return self.flown

    def _checked(self, flown: Flown, now: Situation) -> Flown:
        """Nothing is published that was not traversed; what meets something is braked on before it."""
        self.checked += 1
        if math.isinf(hit_m := first_hit_m(flown, now.p_odom, now.local_map, radius_m=self.hull_radius_m)):
            return flown
        self.refused += 1
        self.whys.append(("brake", f"the way meets something seen after {hit_m:.1f} m"))
        return self._stopped(flown, now, stop_m=hit_m - 2.0 * self.config.speed.stop_margin_m)

    # --- kinds of goals ----------------------------------------------------------------

    def _take_off(self, goal: Goal, now: Situation) -> Flown:
        """Straight up; unknown space is allowed, what is seen is not."""
        if not self._begun or self.flown is None:
            foot = now.p_odom.copy()
            self._target = self._goal_odom = np.array([foot[0], foot[1], goal.p_odom[2]])
            self._at_border = self._substitute = False
            path = np.stack([foot, self._target])
        else:
            path = self.flown.points
        if length(path) < 1e-3:
            return Flown.standing(path[0])
        limits = replace(goal.limits, unknown="optimistic", speed=min(goal.limits.speed, goal.limits.climb))
        space = self._finder.spaces(now.local_map, None, limits).widest
        points = resample(path, self.config.speed.spacing_m)
        distance = space.distance(points)
        risen = np.linalg.norm(points - points[0], axis=1)
        wished = np.minimum(self._finder.least_radius_m(limits), distance[0] + 0.5 * risen)
        low = np.flatnonzero(distance < wished - 0.05)
        stop_m = float(risen[low[0]]) - self.config.speed.stop_margin_m if low.size else math.inf
        self._fails = self._fails + 1 if low.size else 0
        return self._paced(points, space, goal, start=(0.0, 0.0), reach_m=length(path), stop_m=stop_m)

    def _hold(self, goal: Goal, now: Situation) -> Flown:
        """Brake on the way, once; then stay, but for what moves: out of its way, and back."""
        if self._begun and self._aside is not None and self._aside.is_left(now):
            return self._fly(replace(goal, p_odom=self._aside.held_odom), now)
        self._target = self._goal_odom = now.p_odom
        if self._begun and self.flown is not None:
            return self.flown
        still = Flown.standing(now.p_odom)
        flown = still if self.flown is None else self._stopped(self.flown, now, stop_m=-math.inf)
        least_m, held = self._finder.least_radius_m(goal.limits), flown.ahead_until_stop[0][-1]
        self._aside = Aside(held, least_m, goal.limits.unknown)
        return flown

    def _fly(self, goal: Goal, now: Situation) -> Flown:
        kept = commit(self.flown, now.p_odom, now.v_odom, time_s=self.config.commit_s)
        within = self.config.ground_within_m
        self._goal_odom = at_height(goal.p_odom, goal.agl_m, now.local_map, within_m=within, fallback_z=now.ground_z)
        spaces = self._finder.spaces(now.local_map, now.ground, goal.limits)
        rng = np.random.default_rng([self._seed, self._replans])
        if self.reached and not self._substitute and self._good(kept, spaces.widest):
            return self._flown_along(kept, kept.rest, spaces.widest)
        route = self._find(spaces, kept, goal, rng)
        self._proofs = self._proofs + 1 if route is None and self._finder.proven else 0
        old = self._old_way(kept, route, spaces.widest)
        if route is None:
            return self._without_route(kept, old, spaces.widest, now)
        self._fails = 0
        self._target, self._at_border = route.target, route.at_border
        self._substitute, self.iterations = route.substitute, route.iterations
        if old is not None and not self._switches(route, old, spaces.widest):
            way, escape = old, old[:1]
        else:
            way, escape = route.path, route.escape
            self._planned_radius_m = route.space.radius_m
        beyond = self._beyond(goal, route, now, rng)
        flown = self._flown_along(kept, np.vstack([way, beyond[1:]]), route.space, escape=escape)
        if self.flown is not None and flown.strain(goal.limits.accel, now.p_odom, now.v_odom) > self.config.most_strain:
            return self._stopped(self.flown, now, stop_m=-math.inf)  # too fast for it: slow down first
        return flown

    # --- parts of flying ---------------------------------------------------------------

    def _find(self, spaces: Spaces, kept: Commitment, goal: Goal, rng: np.random.Generator) -> Route | None:
        """The goal or, where another may stand for it, the nearest place with all the clearance before less of that."""
        known, before = kept.rest if len(kept.rest) else None, self._target if self._substitute else None
        accept_m = max(goal.radius_m, self.config.route.substitute_m if goal.if_blocked == "nearest_free" else 0.0)
        return self._finder.find(
            spaces, kept.head[-1], self._goal_odom, accept_m=accept_m, rng=rng, known_path=known, before=before
        )

    def _good(self, kept: Commitment, space: FieldSpace) -> bool:
        """Is the rest of the old way still as clear as it was planned, but for the slack?"""
        if len(kept.rest) < 2:
            return False
        least = max(
            self._planned_radius_m - self.config.keep_slack_m,
            self.hull_radius_m + self.config.route.least_clearance_m,
        )
        return math.isinf(clear_m(resample(kept.rest, self.config.speed.spacing_m), space, radius_m=least))

    def _old_way(self, kept: Commitment, route: Route | None, space: FieldSpace) -> Array | None:
        """The old way to the present target, (N, 3); None: there is none or it is no longer good."""
        if not self._good(kept, space):
            return None
        old = cut(kept.rest, 0.0, max(kept.rest_reach_m, 1e-3))
        if route is None:
            return old if self._begun else None
        gap = float(np.linalg.norm(old[-1] - route.target))
        if gap < 1e-3:
            return old
        near = gap < max(0.5, 0.5 * length(old)) and space.segment_free(old[-1], route.target)
        return np.vstack([old, route.target]) if near else None

    def _switches(self, route: Route, old: Array, space: FieldSpace) -> bool:
        """Does the route replace a good old way? Also as it would be flown: no raw way is as long as a smooth one."""
        config = self.config
        if not better(without_repeats(np.vstack([route.escape, route.path])), old, space, config.switch)[0]:
            return False
        new = as_flown(route.escape, route.path, route.space, config.smooth)
        replaces, same = better(new, old, space, config.switch)
        if replaces and not same:
            self.whys.append(("another way", f"{length(new):.1f} m instead of {length(old):.1f} m"))
        return replaces

    def _without_route(self, kept: Commitment, old: Array | None, space: FieldSpace, now: Situation) -> Flown:
        """Keep the old way if it is good; else brake on it before what blocks it."""
        if old is not None:
            return self._flown_along(kept, kept.rest, space)
        self._fails += 1
        if self.flown is None:
            self._target = None
            return Flown.standing(now.p_odom)
        s, _ = project(self.flown.points, now.p_odom)
        least = self._finder.least_radius_m(self.goal.limits) if self.goal else self.hull_radius_m
        blocked_m = clear_m(self.flown.points, space, radius_m=least, from_m=s + 0.2)
        new_goal = not self._begun or self._fails >= self.config.blocked_after
        stop_m = -math.inf if new_goal else blocked_m - 2.0 * self.config.speed.stop_margin_m
        return self._stopped(self.flown, now, stop_m=stop_m)

    def _stopped(self, flown: Flown, now: Situation, *, stop_m: float) -> Flown:
        assert self.goal is not None
        speed = self.config.speed
        return braked(flown, now.p_odom, now.v_odom, self.goal.limits, speed, stop_m=stop_m)

    def _beyond(self, goal: Goal, route: Route, now: Situation, rng: np.random.Generator) -> Array:
        """The way after the target towards the goal that follows; one point: stop at the target."""
        if not goal.fly_through or not len(goal.next_p_odom) or route.at_border or route.substitute:
            return route.target[None]
        within = self.config.ground_within_m
        after = at_height(goal.next_p_odom[0], goal.agl_m, now.local_map, within_m=within, fallback_z=now.ground_z)
        return self._finder.extend(route, after, most_m=self.config.ahead_m, rng=rng)

    def _flown_along(self, kept: Commitment, way: Array, space: FieldSpace, *, escape: Array | None = None) -> Flown:
        """Smooth the way behind the committed head and give it speeds."""
        assert self.goal is not None
        head = kept.head if escape is None else without_repeats(np.vstack([kept.head, escape]))
        path = head
        if length(way) > 1e-3:
            path = smooth(without_repeats(way), space, self.config.smooth, head=head)
        reach_m = length(path) if self._target is None else project(path, self._target)[0]
        return self._paced(path, space, self.goal, start=kept.start, reach_m=reach_m)

    def _paced(
        self,
        path: Array,
        space: FieldSpace,
        goal: Goal,
        *,
        start: tuple[float, float],
        reach_m: float,
        stop_m: float = math.inf,
    ) -> Flown:
        config, limits = self.config, goal.limits
        known_m = self.hull_radius_m + limits.clearance
        if self._standing.creeps:
            known_m = self.hull_radius_m + config.creep_margin_m
            limits = replace(limits, speed=min(limits.speed, config.creep_speed_m_s))
        if goal.kind == "takeoff":
            limits = replace(limits, unknown="optimistic")
        if goal.kind == "takeoff" or not math.isnan(goal.yaw):
            limits = replace(limits, yaw_rate=math.inf)  # the nose does not follow the way
        return with_speeds(
            path,
            space,
            limits,
            config.speed,
            hull_radius_m=self.hull_radius_m,
            known_radius_m=known_m,
            start=start,
            reach_m=reach_m,
            stop_m=stop_m,
            still_map=self._still,
        )
