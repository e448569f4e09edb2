"""The way that is being flown: a route in even steps with speeds, and what to keep of it."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from companion.core.messages import Array, Limits, LocalMap
from companion.planning.bends import spacing_of
from companion.planning.polyline import arc_length, at, cut, length, project, resample, without_repeats
from companion.planning.space import FieldSpace, distance_in
from companion.planning.speed_profile import SpeedConfig, known_free_m, speed_profile, strain

SLOW_M_S = 0.2  # slower than this counts as standing
_BEHIND_M = 0.5  # kept behind the vehicle, so that it finds itself on the new trajectory
_SPEED_SLACK_M_S = 0.5  # trust the planned speed unless the vehicle's own differs by more
_OVERRUN_M = 0.15  # beyond its stop by no more, a vehicle comes back to it
_ASTRAY_M = 0.8  # farther from its route than this, the vehicle starts anew from where it is


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Flown:
    """`points` (N, 3) evenly spaced, `speeds` (N,); beyond the first stop they are only a plan."""

    points: Array
    speeds: Array
    reach_m: float  # arc length of the goal, or of the border of the map
    stop_m: float  # arc length where it is to stop

    @classmethod
    def standing(cls, p_odom: Array) -> Flown:
        """Stay where you are."""
        return cls(points=p_odom[None].copy(), speeds=np.zeros(1), reach_m=0.0, stop_m=0.0)

    @property
    def ahead_until_stop(self) -> tuple[Array, Array]:
        """Points and speeds up to the first stop: what the tracker may fly."""
        moving = np.flatnonzero(self.speeds > 0.0)
        end = min(int(moving[-1]) + 1, len(self.points) - 1) if moving.size else 0
        speeds = self.speeds[: end + 1].copy()
        speeds[-1] = 0.0
        return self.points[: end + 1], speeds

    def strain(self, accel: float, p_odom: Array, v_odom: Array) -> float:
        """Lateral acceleration over the limit, see `speed_profile.strain`, for a vehicle at that place and velocity.

        One that is faster than planned slows down by the whole limit at most, whatever the plan says.
        """
        if len(self.points) < 3:
            return 0.0
        ahead = arc_length(self.points) - project(self.points, p_odom)[0]
        least = np.sqrt(np.maximum(float(v_odom @ v_odom) - 2.0 * accel * ahead, 0.0))
        return strain(self.points, np.where(ahead > 0.0, np.maximum(self.speeds, least), self.speeds), accel)

    def speed_at(self, s: float) -> float:
        """Planned speed at an arc length."""
        return float(np.interp(s, arc_length(self.points), self.speeds))

    def accel_at(self, s: float) -> float:
        """Planned acceleration along the way over one spacing from an arc length, m/s2."""
        step = spacing_of(self.points)
        squared = np.interp([s, s + step], arc_length(self.points), self.speeds**2)
        return float(squared[1] - squared[0]) / (2.0 * step) if step > 0.0 else 0.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Commitment:
    """What is flown whatever the new plan says: `head` (M, 3) ends where the plan starts."""

    head: Array
    start: tuple[float, float]  # speed m/s and acceleration along the way m/s2 at the head's first point
    rest: Array  # of the old route after the head, (K, 3); empty: none
    rest_reach_m: float  # arc length of the old goal on `rest`


def commit(flown: Flown | None, p_odom: Array, v_odom: Array, *, time_s: float) -> Commitment:
    """Keep what the vehicle flies within `time_s`; one that stands or strayed keeps nothing."""
    speed = float(np.linalg.norm(v_odom))
    if flown is None or len(flown.points) < 2:
        place = p_odom if flown is None else _near_or(p_odom, flown.points[0])
        return Commitment(head=place[None], start=(speed, 0.0), rest=np.empty((0, 3)), rest_reach_m=0.0)
    s, off = project(flown.points, p_odom)
    total = length(flown.points)
    end = total if off > _ASTRAY_M else s
    if off <= _ASTRAY_M and speed >= SLOW_M_S:
        end = min(s + speed * time_s, total)
        begin = max(s - _BEHIND_M, 0.0)
        planned = flown.speed_at(begin)
        start = min(max(planned, speed - _SPEED_SLACK_M_S), speed + _SPEED_SLACK_M_S), flown.accel_at(begin)
        head = cut(flown.points, begin, end) if end - begin > 1e-3 else at(flown.points, np.array([end]))
    else:
        start = 0.0 if speed < SLOW_M_S else speed, 0.0
        head = p_odom[None] if off > 0.3 else at(flown.points, np.array([s]))
    rest = cut(flown.points, end, total) if total - end > 1e-3 else np.empty((0, 3))
    return Commitment(head=head, start=start, rest=rest, rest_reach_m=max(flown.reach_m - end, 0.0))


def clear_m(points: Array, space: FieldSpace, *, radius_m: float, from_m: float = 0.0) -> float:
    """Arc length, not before `from_m`, where evenly spaced points come nearer than a radius; inf: never."""
    near = np.flatnonzero(space.distance(points) < radius_m)
    step = spacing_of(points)
    beyond = near[near * step >= from_m]
    return float(beyond[0]) * step if beyond.size else math.inf


def with_speeds(
    path: Array,
    space: FieldSpace,
    limits: Limits,
    config: SpeedConfig,
    *,
    hull_radius_m: float,
    known_radius_m: float,
    start: tuple[float, float],
    reach_m: float,
    stop_m: float = math.inf,
    still_map: LocalMap | None = None,
) -> Flown:
    """Speeds for a path (N, 3): slow near obstacles, a stop at `stop_m` or before unknown space.

    Space counts as known when a ball of `known_radius_m` ahead is (the hull's at least). A way that begins too near to
    what moves is as fast as `still_map`, which is without that, allows: one gets out of the way, and does not creep.
    """
    path = without_repeats(path)
    if len(path) < 2:
        return Flown.standing(path[0])
    points = resample(path, config.spacing_m)
    if limits.unknown != "optimistic":
        known = known_free_m(points, space.map, config, (known_radius_m, hull_radius_m))
        stop_m = min(stop_m, max(known - config.stop_margin_m, 0.0))
    clearance_m = space.distance(points) - hull_radius_m
    if still_map is not None and still_map is not space.map:
        leaving = ~np.logical_or.accumulate(clearance_m >= limits.clearance)
        clearance_m = np.where(leaving, distance_in(still_map, points) - hull_radius_m, clearance_m)
    speeds = speed_profile(points, limits, config, clearance_m=clearance_m, start=start, stop_m=stop_m)
    return Flown(points=points, speeds=speeds, reach_m=reach_m, stop_m=stop_m)


def braked(flown: Flown, p_odom: Array, v_odom: Array, limits: Limits, config: SpeedConfig, *, stop_m: float) -> Flown:
    """The same route, stopping at arc length `stop_m` of it, or as soon as it can, whatever the jerk."""
    if len(flown.points) < 2:
        return flown
    s, _ = project(flown.points, p_odom)
    speed = float(np.linalg.norm(v_odom))
    begin = max(s - _BEHIND_M, 0.0)
    points = resample(cut(flown.points, begin, length(flown.points)), config.spacing_m)
    soonest = s + speed**2 / (2.0 * config.along_share * limits.accel)
    if soonest < flown.stop_m + _OVERRUN_M:  # a gust must not move the place to hold on and on
        soonest = min(soonest, flown.stop_m)
    stop_m = max(min(stop_m, flown.stop_m), soonest) - begin
    speeds = speed_profile(
        points,
        replace(limits, jerk=math.inf),
        config,
        clearance_m=np.full(len(points), np.inf),
        start=(max(speed, flown.speed_at(begin)) if speed > SLOW_M_S else 0.0, 0.0),
        stop_m=stop_m,
    )
    return replace(flown, points=points, speeds=speeds, reach_m=flown.reach_m - begin, stop_m=stop_m)


def _near_or(p_odom: Array, anchor: Array) -> Array:
    """The anchor while the vehicle is near it: a standing vehicle does not follow its own drift."""
    return anchor if float(np.linalg.norm(p_odom - anchor)) < 0.3 else p_odom
