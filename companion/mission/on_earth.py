"""A mission as places on Earth, for an autopilot that flies it by itself: `places_of(mission, origin)`.

Heights are above home. What the companion decides in flight is lost: the way around obstacles, clearance, height
above ground (taken as height above home), what happens when a step fails.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Final, Literal, NamedTuple

from companion.core.errors import InputError
from companion.mission.route import legs_of
from companion.mission.schema import AnyStep, Hover, Land, Mission, ReturnHome

SEMI_MAJOR_M: Final = 6_378_137.0  # WGS 84
ECCENTRICITY2: Final = 6.694379990141e-3
POLE_DEG: Final = 89.0


class Origin(NamedTuple):
    """Where home is, and where the vehicle looks there: compass heading of home's x axis."""

    latitude_deg: float
    longitude_deg: float
    heading_deg: float


class Place(NamedTuple):
    """One thing to do; coordinates are NaN where it is done wherever the vehicle is."""

    do: Literal["takeoff", "fly", "hover", "return", "land"]
    latitude_deg: float
    longitude_deg: float
    height_m: float  # above home
    speed: float  # m/s on the way there
    seconds: float = 0.0


def places_of(mission: Mission, origin: Origin) -> list[Place]:
    """Every step in order; raises InputError for one that is no place on Earth, and for an origin that is none."""
    _check(origin)
    found: list[Place] = []
    xy = (0.0, 0.0)
    for index, step in enumerate(mission.steps):
        found += _done_there(mission, step)
        for leg in () if _lands_at_home(step) else legs_of(mission, step, xy):
            if leg.frame != "home":
                raise InputError(
                    f"frame {leg.frame} is known only in flight", field=f"{mission.id_of(index)}.frame", valid="home"
                )
            xy = (float(leg.p[0]), float(leg.p[1]))
            latitude_deg, longitude_deg = to_earth(*xy, origin)
            do: Literal["takeoff", "fly"] = "takeoff" if leg.kind == "takeoff" else "fly"
            speed = mission.limits_of(step).speed
            found.append(Place(do, latitude_deg, longitude_deg, float(leg.p[2]), speed))
    return found


def _done_there(mission: Mission, step: AnyStep) -> Iterator[Place]:
    here, speed = (math.nan, math.nan, math.nan), mission.limits_of(step).speed
    if isinstance(step, Hover):
        yield Place("hover", *here, speed, step.seconds)
    elif isinstance(step, Land):
        yield Place("land", *here, speed)
    elif _lands_at_home(step):
        yield Place("return", *here, speed)


def _lands_at_home(step: AnyStep) -> bool:
    """Then the autopilot's own return does it; without a landing home is a place like another."""
    return isinstance(step, ReturnHome) and step.land == "land"


def to_earth(x_home: float, y_home: float, origin: Origin) -> tuple[float, float]:
    """Latitude and longitude, degrees, of a point in the home frame (x ahead, y left), m, near the origin."""
    heading, latitude = math.radians(origin.heading_deg), math.radians(origin.latitude_deg)
    north = x_home * math.cos(heading) + y_home * math.sin(heading)
    east = x_home * math.sin(heading) - y_home * math.cos(heading)
    w2 = 1.0 - ECCENTRICITY2 * math.sin(latitude) ** 2
    meridian_m = SEMI_MAJOR_M * (1.0 - ECCENTRICITY2) / w2**1.5
    parallel_m = SEMI_MAJOR_M / math.sqrt(w2) * math.cos(latitude)
    return origin.latitude_deg + math.degrees(north / meridian_m), origin.longitude_deg + math.degrees(
        east / parallel_m
    )


def _check(origin: Origin) -> None:
    for name, value, most in (
        ("latitude", origin.latitude_deg, POLE_DEG),
        ("longitude", origin.longitude_deg, 180.0),
        ("heading", origin.heading_deg, 360.0),
    ):
        if not abs(value) <= most:
            raise InputError(f"{value:g} is no {name}", field="origin", valid=f"-{most:g}..{most:g} degrees")
