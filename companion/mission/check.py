"""What the types of a mission cannot say: order, ids, heights, polygons, fence, time."""

from __future__ import annotations

import math

import numpy as np
from msgspec import UnsetType

from companion.core.fence import area_m2, crossing_edges
from companion.core.strict_types import Path
from companion.core.strict_yaml import Document
from companion.mission.estimate import estimate, total_time_s
from companion.mission.route import legs_of
from companion.mission.schema import (
    FollowPath,
    Goto,
    Hover,
    Land,
    Mission,
    ReturnHome,
    Survey,
    Takeoff,
    set_or,
)
from companion.mission.survey import best_heading, lane_count

MAX_LANES = 200


def check_mission(document: Document, mission: Mission) -> None:
    """Raise InputError, with its line, at the first thing that cannot be flown."""
    _check_order(document, mission)
    _check_ids(document, mission)
    _check_fence(document, mission)
    for index in range(len(mission.steps)):
        _check_limits(document, mission, index)
        _check_on_fail(document, mission, index)
        _check_heights(document, mission, index)
        _check_survey(document, mission, index)
        _check_inside(document, mission, index)
    _check_time(document, mission)


def _check_order(document: Document, mission: Mission) -> None:
    last = len(mission.steps) - 1
    for index, step in enumerate(mission.steps):
        path: Path = ("steps", index, "do")
        if isinstance(step, Takeoff) != (index == 0):
            problem = "a mission begins with a takeoff" if index == 0 else "already flying"
            valid = "takeoff" if index == 0 else "one takeoff, as the first step"
            raise document.error(path, problem, valid=valid)
        lands = isinstance(step, Land) or (isinstance(step, ReturnHome) and step.land == "land")
        if lands and index < last:
            raise document.error(path, "nothing can follow a landing", valid="land as the last step")
        if not lands and index == last:
            valid = "land, or return_home with land: land"
            raise document.error(path, "the last step leaves the vehicle in the air", valid=valid)


def _check_ids(document: Document, mission: Mission) -> None:
    seen: dict[str, int] = {}
    for index in range(len(mission.steps)):
        name = mission.id_of(index)
        if name in seen:
            line = document.line_of(("steps", seen[name]))
            raise document.error(("steps", index, "id"), f"{name} is taken by line {line}", valid="another id")
        seen[name] = index


def _check_fence(document: Document, mission: Mission) -> None:
    fence = mission.fence
    if fence is None:
        return
    _check_polygon(document, ("geofence", "inside"), fence.inside)
    if fence.alt[0] >= fence.alt[1]:
        raise document.error(("geofence", "alt"), "floor above ceiling", valid="[lowest, highest] in m")
    if fence.alt[0] > -0.5:
        problem = f"a floor at {fence.alt[0]:g} m would stop the takeoff"
        raise document.error(("geofence", "alt", 0), problem, valid="-0.5 or less: the ground slopes")
    if fence.depth_m(np.array([0.0, 0.0, mission.takeoff_alt_m])) <= 0:
        raise document.error(("geofence",), "the takeoff lies outside", valid="a fence around (0, 0)")


def _check_polygon(document: Document, path: Path, polygon: tuple[tuple[float, float], ...]) -> None:
    crossing = crossing_edges(polygon)
    if crossing is not None:
        i, j = crossing
        raise document.error((*path, j), f"edge {j} crosses edge {i}", valid="corners in order, without crossing")
    if area_m2(polygon) < 1.0:
        raise document.error(path, f"covers {area_m2(polygon):.2f} m2", valid="at least 1 m2")


def _check_limits(document: Document, mission: Mission, index: int) -> None:
    step, limits = mission.steps[index], mission.limits_of(mission.steps[index])
    if isinstance(step, Land) and step.limits != type(step.limits)():
        path: Path = ("steps", index, "limits")
        raise document.error(path, "the autopilot lands with its own limits", valid="id, timeout_s")
    if not 0 <= limits.agl_min < limits.agl_max:
        own = not isinstance(step.limits.agl, UnsetType)
        path = ("steps", index, "limits", "agl") if own else ("defaults", "agl")
        problem = f"[{limits.agl_min:g}, {limits.agl_max:g}] is not a band"
        raise document.error(path, problem, valid="[lowest, highest] in m above ground, from 0 up")


def _check_on_fail(document: Document, mission: Mission, index: int) -> None:
    step, path = mission.steps[index], ("steps", index, "on_fail")
    if isinstance(step.on_fail, UnsetType):
        return
    rule = step.on_fail
    if isinstance(step, Land | Hover):
        raise document.error(path, f"{mission.id_of(index)} has no other way to go", valid="id, timeout_s")
    if rule.do != "retry":
        for key in ("retries", "then"):
            if not isinstance(getattr(rule, key), UnsetType):
                raise document.error((*path, key), f"means nothing with do: {rule.do}", valid="do: retry")
    if isinstance(step, Takeoff) and "skip" in (rule.do, set_or(rule.then, "abort")):
        raise document.error(path, "a takeoff cannot be skipped", valid="retry, land_here, abort")


def _check_heights(document: Document, mission: Mission, index: int) -> None:
    step, limits = mission.steps[index], mission.limits_of(mission.steps[index])
    band = f"{limits.agl_min:g} to {limits.agl_max:g} m above ground (agl)"

    def inside(height_m: float, *key: str | int) -> None:
        if not limits.agl_min <= height_m <= limits.agl_max:
            raise document.error(("steps", index, *key), f"{height_m:g} is outside the agl band", valid=band)

    if isinstance(step, Takeoff):
        inside(step.alt, "alt")
    elif isinstance(step, Survey):
        inside(step.agl, "agl")
    elif isinstance(step, Goto) and step.alt_ref == "agl":
        inside(step.at[2], "at", 2)
    elif isinstance(step, FollowPath) and step.alt_ref == "agl":
        for k, point in enumerate(step.points):
            inside(point[2], "points", k, 2)
    elif isinstance(step, ReturnHome):
        inside(mission.takeoff_alt_m, "limits", "agl")


def _check_survey(document: Document, mission: Mission, index: int) -> None:
    step = mission.steps[index]
    if not isinstance(step, Survey):
        return
    _check_polygon(document, ("steps", index, "area"), step.area)
    auto = step.heading_deg == "auto"
    heading = best_heading(step.area, step.spacing) if auto else math.radians(float(step.heading_deg))
    passes = (0.0, math.pi / 2) if step.pattern == "crosshatch" else (0.0,)
    count = max(lane_count(step.area, step.spacing, heading + turn) for turn in passes)
    if count > MAX_LANES:
        least = step.spacing * count / MAX_LANES
        problem = f"{step.spacing:g} gives {count} lanes, more than {MAX_LANES}"
        raise document.error(("steps", index, "spacing"), problem, valid=f"about {least:.2g} m or more")


def _check_inside(document: Document, mission: Mission, index: int) -> None:
    """Goals against the fence; body goals are checked in flight, when they are known."""
    step, fence = mission.steps[index], mission.fence
    if fence is None:
        return
    for k, leg in enumerate(legs_of(mission, step, (0.0, 0.0))):
        depth_m = fence.depth_m(leg.p)
        if leg.frame != "body" and depth_m <= 0:
            path: Path = ("steps", index, *_key_of_leg(step, k))
            problem = f"({leg.p[0]:.1f}, {leg.p[1]:.1f}, {leg.p[2]:.1f}) is {-depth_m:.1f} m outside the fence"
            raise document.error(path, problem, valid=f"inside geofence, line {document.line_of(('geofence',))}")


def _key_of_leg(step: object, leg: int) -> Path:
    if isinstance(step, FollowPath):
        return ("points", leg)
    if isinstance(step, Survey):
        return ("area",)
    return ("at",) if isinstance(step, Goto) else ("alt",) if isinstance(step, Takeoff) else ("do",)


def _check_time(document: Document, mission: Mission) -> None:
    needed_s, limit_s = total_time_s(estimate(mission)), mission.failsafe.time_limit_s
    if needed_s > limit_s:
        problem = f"{limit_s:g} is too short: the steps take {needed_s:.0f} s at best"
        raise document.error(("failsafe", "time_limit_s"), problem, valid=f"more than {needed_s:.0f} s")
