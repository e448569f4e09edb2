"""Planning: at each local map and each goal a trajectory, ten times a second whether it is reached."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from companion.core import topics
from companion.core.messages import (
    Array32,
    Goal,
    LocalMap,
    ObstacleTracks,
    Odometry,
    PlanStatus,
    RangeReading,
    Trajectory,
    Why,
)
from companion.core.node import Node, Outputs, every, on
from companion.planning.config import PlanningConfig
from companion.planning.flown import Flown
from companion.planning.landing import Columns, beam_fault, stopping_place
from companion.planning.moving import is_crossed, with_moving
from companion.planning.polyline import at, cut, length, project
from companion.planning.replanner import Replanner, State
from companion.planning.situation import Situation
from companion.planning.space import fill_ground, serves
from companion.planning.target import ground_below
from companion.planning.warm_up import warm_up

_LOOK_M = 2.0  # a trajectory that ends sooner looks at the route this far ahead
_RANGE_FRESH_NS = 300_000_000
_STATUS_SPACING = 5  # every so manieth point of the route is shown


class PlanningNode(Node):
    """Holds the newest inputs; `Replanner` decides."""

    publishes = (topics.TRAJECTORY, topics.PLAN, topics.WHY)

    def __init__(self, config: PlanningConfig, *, hull_radius_m: float, seed: int) -> None:
        self.config = config
        self._hull_radius_m = hull_radius_m
        self._range: RangeReading | None = None
        self._landing: Goal | None = None  # the goal of kind land that is flown
        self._moves = 0  # places given up for it
        self._waits = False  # it is put off: something that moves would come by
        self._no_place = ""  # why the vehicle should not land where it is; '' if nothing is against it
        self._replanner = Replanner(config, hull_radius_m=hull_radius_m, seed=seed)
        self._odometry: Odometry | None = None
        self._map: LocalMap | None = None
        self._tracks: ObstacleTracks | None = None
        self._ground: Array32 | None = None
        self._ground_z = math.nan  # last seen under the vehicle
        warm_up(config, hull_radius_m=hull_radius_m)

    @on(topics.ODOMETRY)
    def take_odometry(self, message: Odometry) -> None:
        """The newest state."""
        self._odometry = message

    @on(topics.GOAL)
    def take_goal(self, message: Goal) -> Outputs:
        """A new goal is planned for at once."""
        self._no_place, self._landing, self._moves, self._waits = "", None, 0, False
        if message.kind == "land":
            self._landing, message = message, self._above_a_place(message)
        self._replanner.take_goal(message)
        yield from self._replan()

    @on(topics.RANGE)
    def take_range(self, message: RangeReading) -> None:
        """What is straight below."""
        self._range = message

    @on(topics.OBSTACLE_TRACKS)
    def take_tracks(self, message: ObstacleTracks) -> None:
        """What moves."""
        self._tracks = message

    def _above_a_place(self, goal: Goal, *, beyond_m: float = 0.0) -> Goal:
        """To land: fly above the nearest place where the column is known free; if there is none, stop and say so."""
        config, odometry, local_map = self.config.landing, self._odometry, self._map
        if odometry is None or local_map is None:
            self._no_place = "nothing is known of the column below: there is no local map"
            return replace(goal, kind="hold")
        stop = stopping_place(odometry.p_odom, odometry.v_odom, accel=goal.limits.accel)
        radius_m = self._hull_radius_m + config.pad_m
        columns = Columns(local_map, top_z_odom=float(stop[2]), radius_m=radius_m, config=config)
        place = columns.nearest(stop, beyond_m=beyond_m)
        if place is None:
            below = columns.fault(stop) or self._seen_below(odometry, local_map)
            self._no_place = f"no place to land within {config.within_m:g} m; below, {below}"
            return replace(goal, kind="hold")
        return replace(goal, kind="fly", p_odom=place, if_blocked="fail")

    def _seen_below(self, odometry: Odometry, local_map: LocalMap) -> str:
        """What the range finder sees that the map does not hold; '' if nothing, or if it is silent."""
        fresh = self._range is not None and abs(odometry.stamp_ns - self._range.stamp_ns) < _RANGE_FRESH_NS
        if self._range is None or not fresh:
            return ""
        ground_z = ground_below(local_map, odometry.p_odom, within_m=self._hull_radius_m, fallback_z=math.nan)
        height_m = float(odometry.p_odom[2]) - ground_z
        return beam_fault(self._range.range_m, odometry.q_odom_body, height_m, self.config.landing)

    def _move_aside(self) -> None:
        """Above the place to land, something stands in the range finder's beam: another place."""
        landing, odometry, local_map = self._landing, self._odometry, self._map
        if landing is None or odometry is None or local_map is None or not self._replanner.reached:
            return
        if (
            self._waits
            or self._no_place
            or self._moves >= self.config.landing.moves
            or not self._seen_below(odometry, local_map)
        ):
            return
        self._moves += 1
        self._replanner.take_goal(self._above_a_place(landing, beyond_m=self.config.landing.aside_m))

    def _wait_for_what_moves(self) -> None:
        """While it would come over the place to land, or where the vehicle is, it holds and keeps out of its way."""
        landing, goal, odometry = self._landing, self._replanner.goal, self._odometry
        if landing is None or goal is None or odometry is None or self._map is None:
            return
        places = np.stack([odometry.p_odom, goal.p_odom])
        reach_m, clear_s = self._hull_radius_m + self.config.landing.pad_m, self.config.landing.clear_s
        moving = self.config.moving
        waits = is_crossed(places, self._tracks, odometry.stamp_ns, moving, within_s=clear_s, hull_m=reach_m)
        if waits != self._waits:
            self._waits, self._no_place = waits, ""
            hold = replace(landing, kind="hold", p_odom=goal.p_odom)
            self._replanner.take_goal(hold if waits else self._above_a_place(landing))
            what = "wait before landing" if waits else "land after all"
            self._replanner.whys.append((what, f"what moves {'comes' if waits else 'does not come'} by"))

    @on(topics.LOCAL_MAP)
    def take_map(self, message: LocalMap) -> Outputs:
        """A new map: replan."""
        self._map = message
        if self._odometry is not None:
            within = self.config.ground_within_m
            p = self._odometry.p_odom
            self._ground_z = ground_below(message, p, within_m=within, fallback_z=self._ground_z)
        self._ground = fill_ground(message, fallback_z=self._ground_z)
        yield from self._replan()

    @every(hz=10)
    def watch(self, now_ns: int) -> Outputs:
        """Is the goal reached? Says so between replans."""
        if self._odometry is not None:
            self._replanner.look(self._odometry.p_odom, self._odometry.v_odom)
        self._wait_for_what_moves()
        self._move_aside()
        yield topics.PLAN(self._status(now_ns))

    def _replan(self) -> Outputs:
        self._wait_for_what_moves()
        goal, odometry, local_map = self._replanner.goal, self._odometry, self._map
        if goal is None or odometry is None or local_map is None:
            return
        if goal.kind == "fly" and not serves(local_map, goal.limits.unknown):
            return  # the maps that follow know how far unknown space is: mapping hears of the goal, too
        now = Situation(
            p_odom=odometry.p_odom,
            v_odom=odometry.v_odom,
            local_map=with_moving(local_map, self._tracks, odometry.stamp_ns, self.config.moving),
            still_map=local_map,
            ground=self._ground,
            ground_z=self._ground_z,
        )
        flown = self._replanner.update(now)
        self._move_aside()  # before anybody hears that it is reached
        yield topics.TRAJECTORY(self._trajectory(odometry, goal, flown))
        yield topics.PLAN(self._status(odometry.stamp_ns))
        for what, because in self._replanner.whys:
            yield topics.WHY(Why(stamp_ns=odometry.stamp_ns, node="planning", what=what, because=because))
        self._replanner.whys.clear()

    def _trajectory(self, odometry: Odometry, goal: Goal, flown: Flown) -> Trajectory:
        points, speeds = flown.ahead_until_stop
        return Trajectory(
            stamp_ns=odometry.stamp_ns,
            goal_id=goal.id,
            p_odom=points.copy(),
            speed=speeds,
            accel_limit=goal.limits.accel,
            yaw=_look(flown, odometry, goal, turn_above_m=self.config.turn_above_m),
            yaw_rate_limit=goal.limits.yaw_rate,
        )

    @property
    def _state(self) -> State:
        """On its way while it waits to land: neither there nor without a way."""
        if self._waits:
            return "flying"
        return "blocked" if self._no_place else self._replanner.state

    def _status(self, now_ns: int) -> PlanStatus:
        replanner, odometry = self._replanner, self._odometry
        goal, flown = replanner.goal, replanner.flown
        ahead, distance_m = np.empty((0, 3)), math.nan
        if flown is not None and odometry is not None and len(flown.points) > 1:
            s, _ = project(flown.points, odometry.p_odom)
            ahead = cut(flown.points, s, length(flown.points))[::_STATUS_SPACING]
            distance_m = max(flown.reach_m - s, 0.0)
        return PlanStatus(
            stamp_ns=now_ns,
            goal_id=goal.id if goal is not None else -1,
            state=self._state,
            distance_m=distance_m,
            plan_p_odom=ahead,
            cost_m=flown.reach_m if flown is not None else math.nan,
            iterations=replanner.iterations,
            reason=self._no_place or (replanner.reason if self._state == "blocked" else ""),
            checked=replanner.checked,
            refused=replanner.refused,
        )


def _look(flown: Flown, odometry: Odometry, goal: Goal, *, turn_above_m: float) -> float:
    """Heading asked for; NaN: along the path.

    When the trajectory ends soon (unknown space ahead), along the route: looking there is what
    makes it known.
    """
    if goal.kind == "takeoff" and odometry.p_odom[2] - flown.points[0, 2] < turn_above_m:
        return math.nan
    if not math.isnan(goal.yaw) or goal.kind != "fly" or len(flown.points) < 2:
        return goal.yaw
    s, _ = project(flown.points, odometry.p_odom)
    if length(flown.ahead_until_stop[0]) - s > 1.0:
        return math.nan
    way = at(flown.points, np.array([s + _LOOK_M]))[0] - odometry.p_odom
    return math.atan2(way[1], way[0]) if math.hypot(way[0], way[1]) > 0.4 else math.nan
