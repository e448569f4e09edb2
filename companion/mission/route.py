"""Steps -> legs: the goals that a step sends, in the step's own frame. Dry run and flight share this."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from typing import Literal

import numpy as np

from companion.core.messages import Array
from companion.mission.schema import AnyStep, FollowPath, Frame, Goto, Mission, ReturnHome, Survey, Takeoff
from companion.mission.survey import survey_path

LEG_M = 10.0  # longer lanes are split, so that height and map correction are taken anew
STRAIGHT_RAD = math.radians(20.0)
SURVEY_RADIUS_M = 0.8
HOME_RADIUS_M = 0.3
TURN_RAD = 3.0  # on taking off; a little less than half round, so that the shorter way is sure


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Leg:
    """One goal before it is placed into odom. `p` (3,) m in `frame`; with `agl_m`, p[2] is only nominal."""

    p: Array
    frame: Frame = "home"
    agl_m: float = math.nan
    radius_m: float = 0.5
    fly_through: bool = False
    yaw: float | Literal["along_path", "hold", "turned"] = "along_path"
    if_blocked: Literal["nearest_free", "fail"] = "nearest_free"
    kind: Literal["takeoff", "fly"] = "fly"


def legs_of(mission: Mission, step: AnyStep, start_xy: tuple[float, float], *, leg_m: float = LEG_M) -> tuple[Leg, ...]:
    """Goals of one step, begun at `start_xy` (home frame); none for hover and land.

    Survey lanes, and the way to the first, are split into stretches of `leg_m` at most.
    """
    match step:
        case Takeoff():
            return (_takeoff(step),)
        case Goto():
            return (_goto(step),)
        case FollowPath():
            return _follow(step)
        case Survey():
            return _survey(step, start_xy, leg_m)
        case ReturnHome():
            return (home_leg(mission),)
        case _:
            return ()


def home_leg(mission: Mission) -> Leg:
    """Back to above where the vehicle armed."""
    alt = mission.takeoff_alt_m
    return Leg(p=np.array([0.0, 0.0, alt]), agl_m=alt, radius_m=HOME_RADIUS_M)


def _takeoff(step: Takeoff) -> Leg:
    p = np.array([0.0, 0.0, step.alt])
    return Leg(p=p, radius_m=HOME_RADIUS_M, yaw="turned" if step.turn else "along_path", kind="takeoff")


def _goto(step: Goto) -> Leg:
    return Leg(
        p=np.array(step.at),
        frame=step.frame,
        agl_m=step.at[2] if step.alt_ref == "agl" else math.nan,
        radius_m=step.radius,
        fly_through=step.fly_through,
        yaw=step.yaw,
        if_blocked=step.if_blocked,
    )


def _follow(step: FollowPath) -> tuple[Leg, ...]:
    last = len(step.points) - 1
    return tuple(
        Leg(
            p=np.array(point),
            frame=step.frame,
            agl_m=point[2] if step.alt_ref == "agl" else math.nan,
            radius_m=step.radius,
            fly_through=k < last,
            yaw=step.yaw,
            if_blocked=step.if_blocked,
        )
        for k, point in enumerate(step.points)
    )


def _survey(step: Survey, start_xy: tuple[float, float], leg_m: float) -> tuple[Leg, ...]:
    lanes = survey_path(
        step.area,
        spacing_m=step.spacing,
        heading_rad=None if step.heading_deg == "auto" else math.radians(step.heading_deg),
        crosshatch=step.pattern == "crosshatch",
        start_xy=start_xy,
    )
    path = split(np.vstack([start_xy, lanes]), leg_m)
    through = _straight(path)[1:]
    return tuple(
        Leg(
            p=np.array([x, y, step.agl]),
            frame=step.frame,
            agl_m=step.agl,
            radius_m=SURVEY_RADIUS_M,
            fly_through=bool(through[k]),
            if_blocked="nearest_free" if step.skip_unreachable else "fail",
        )
        for k, (x, y) in enumerate(path[1:])
    )


def split(path: Array, most_m: float) -> Array:
    """The same polyline (N, 2) with no stretch longer than `most_m`; equal parts."""
    points = [path[:1]]
    for a, b in itertools.pairwise(path):
        parts = max(1, math.ceil(float(np.hypot(*(b - a))) / most_m - 1e-9))
        points.append(a + (b - a) * (np.arange(1, parts + 1) / parts)[:, None])
    return np.vstack(points)


def _straight(path: Array) -> Array:
    """Which points (N,) are passed without a turn; the ends are not."""
    way = np.diff(path, axis=0)
    heading = np.arctan2(way[:, 1], way[:, 0])
    turn = np.abs((np.diff(heading) + np.pi) % (2 * np.pi) - np.pi)
    through = np.zeros(len(path), bool)
    through[1:-1] = turn < STRAIGHT_RAD
    return through
