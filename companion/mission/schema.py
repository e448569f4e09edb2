"""The structs of mission schema v1: one YAML file, data only.

SI units and radians, unless a key says otherwise by its name (`heading_deg`, `timeout_s`).
"""

from __future__ import annotations

from typing import Annotated, Literal, TypeVar

import msgspec
from msgspec import UNSET, UnsetType

from companion.core.fence import Fence, Metre
from companion.core.messages import Limits

Frame = Literal["home", "map", "body"]
Action = Literal["skip", "hold", "return_home", "land_here", "abort"]
Name = Annotated[str, msgspec.Meta(pattern=r"^[a-z][a-z0-9_]*$", max_length=40)]
Positive = Annotated[float, msgspec.Meta(gt=0)]
PositiveMetre = Annotated[float, msgspec.Meta(gt=0, extra={"unit": "m"})]
Share = Annotated[float, msgspec.Meta(ge=0, le=1, extra={"unit": "share"})]
Angle = Annotated[float, msgspec.Meta(ge=-6.3, le=6.3, extra={"unit": "rad"})]
Point = tuple[Metre, Metre, Metre]
Corner = tuple[Metre, Metre]
Polygon = Annotated[tuple[Corner, ...], msgspec.Meta(min_length=3, max_length=200)]


class StrictStruct(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Base: no unknown keys."""


class StepLimits(StrictStruct, frozen=True, kw_only=True):
    """What a step changes of the defaults."""

    speed: Annotated[float, msgspec.Meta(gt=0, le=20, extra={"unit": "m/s"})] | UnsetType = UNSET
    climb: Annotated[float, msgspec.Meta(gt=0, le=10, extra={"unit": "m/s"})] | UnsetType = UNSET
    accel: Annotated[float, msgspec.Meta(gt=0, le=20, extra={"unit": "m/s2"})] | UnsetType = UNSET
    jerk: Annotated[float, msgspec.Meta(gt=0, le=200, extra={"unit": "m/s3"})] | UnsetType = UNSET
    yaw_rate: Annotated[float, msgspec.Meta(gt=0, le=6.3, extra={"unit": "rad/s"})] | UnsetType = UNSET
    clearance: Annotated[float, msgspec.Meta(ge=0, le=10, extra={"unit": "m"})] | UnsetType = UNSET
    unknown: Literal["blocked", "stop_before", "optimistic"] | UnsetType = UNSET
    agl: tuple[Metre, Metre] | UnsetType = UNSET


class OnFail(StrictStruct, frozen=True, kw_only=True):
    """What to do when a step fails; after `retries` of `retry`, `then`."""

    do: Literal["retry", "skip", "hold", "return_home", "land_here", "abort"]
    retries: Annotated[int, msgspec.Meta(ge=1, le=20)] | UnsetType = UNSET
    then: Action | UnsetType = UNSET


class Step(StrictStruct, frozen=True, kw_only=True, tag_field="do"):
    """What every step may say."""

    id: Name | UnsetType = UNSET
    timeout_s: Positive | UnsetType = UNSET
    limits: StepLimits = StepLimits()
    on_fail: OnFail | UnsetType = UNSET


class Takeoff(Step, frozen=True, kw_only=True, tag="takeoff"):
    """Climb straight up to `alt` above home, turning about: that tells the accelerometer's bias from a tilt."""

    alt: Annotated[float, msgspec.Meta(gt=0, le=120, extra={"unit": "m"})]
    turn: bool = True


class Goto(Step, frozen=True, kw_only=True, tag="goto"):
    """Fly to one point; `alt_ref: agl` takes its third number as height above ground."""

    at: Point
    frame: Frame = "home"
    alt_ref: Literal["home", "agl"] = "home"
    yaw: Literal["along_path", "hold"] | Angle = "along_path"
    radius: PositiveMetre = 0.5
    fly_through: bool = False
    if_blocked: Literal["nearest_free", "fail"] = "nearest_free"


class FollowPath(Step, frozen=True, kw_only=True, tag="follow_path"):
    """Fly through points, stopping at the last."""

    points: Annotated[tuple[Point, ...], msgspec.Meta(min_length=2, max_length=500)]
    frame: Frame = "home"
    alt_ref: Literal["home", "agl"] = "home"
    yaw: Literal["along_path", "hold"] | Angle = "along_path"
    radius: PositiveMetre = 0.5
    if_blocked: Literal["nearest_free", "fail"] = "nearest_free"


class Survey(Step, frozen=True, kw_only=True, tag="survey"):
    """Fly lanes over a polygon at a height above ground."""

    area: Polygon
    spacing: PositiveMetre
    agl: PositiveMetre = 2.0
    frame: Literal["home", "map"] = "home"
    heading_deg: Literal["auto"] | Annotated[float, msgspec.Meta(ge=-360, le=360)] = "auto"
    pattern: Literal["lawnmower", "crosshatch"] = "lawnmower"
    skip_unreachable: bool = True


class Hover(Step, frozen=True, kw_only=True, tag="hover"):
    """Stop and stay."""

    seconds: Annotated[float, msgspec.Meta(gt=0, le=600, extra={"unit": "s"})]


class ReturnHome(Step, frozen=True, kw_only=True, tag="return_home"):
    """Fly back to where it armed, at the height of the takeoff above ground; land there if told."""

    land: Literal["none", "land"] = "land"


class Land(Step, frozen=True, kw_only=True, tag="land"):
    """Land where it is."""


AnyStep = Takeoff | Goto | FollowPath | Survey | Hover | ReturnHome | Land


class Battery(StrictStruct, frozen=True, kw_only=True):
    """Below `reserve` of a full battery the mission ends."""

    reserve: Share = 0.25
    do: Literal["return_home", "land_here"] = "return_home"


class PlannerStuck(StrictStruct, frozen=True, kw_only=True):
    """No way or no progress for `after_s` fails the step; `do` serves steps without `on_fail`."""

    after_s: Positive = 12.0
    do: Action = "return_home"


class Failsafe(StrictStruct, frozen=True, kw_only=True):
    """What ends a mission early."""

    battery: Battery = Battery()
    planner_stuck: PlannerStuck = PlannerStuck()
    time_limit_s: Positive = 1800.0


class Mission(StrictStruct, frozen=True, kw_only=True):
    """A whole mission file."""

    version: Literal[1]
    name: Name
    description: str = ""
    defaults: StepLimits = StepLimits()
    geofence: Fence | UnsetType = UNSET
    failsafe: Failsafe = Failsafe()
    steps: Annotated[tuple[AnyStep, ...], msgspec.Meta(min_length=1, max_length=500)]

    @property
    def fence(self) -> Fence | None:
        """The geofence, or None."""
        return None if isinstance(self.geofence, UnsetType) else self.geofence

    @property
    def takeoff_alt_m(self) -> float:
        """Height of the first takeoff above home, m."""
        return next((s.alt for s in self.steps if isinstance(s, Takeoff)), 2.0)

    def limits_of(self, step: AnyStep) -> Limits:
        """The step's limits over the mission's defaults over the built-in ones."""
        own, file = step.limits, self.defaults
        agl_min, agl_max = set_or(own.agl, set_or(file.agl, (0.8, 30.0)))
        return Limits(
            speed=set_or(own.speed, set_or(file.speed, 2.0)),
            climb=set_or(own.climb, set_or(file.climb, 1.0)),
            accel=set_or(own.accel, set_or(file.accel, 3.0)),
            jerk=set_or(own.jerk, set_or(file.jerk, 20.0)),
            yaw_rate=set_or(own.yaw_rate, set_or(file.yaw_rate, 1.5)),
            clearance=set_or(own.clearance, set_or(file.clearance, 0.4)),
            unknown=set_or(own.unknown, set_or(file.unknown, "stop_before")),
            agl_min=agl_min,
            agl_max=agl_max,
        )

    def id_of(self, index: int) -> str:
        """The step's id, or its verb and number."""
        step = self.steps[index]
        return str(step.__struct_config__.tag) + f"_{index}" if isinstance(step.id, UnsetType) else step.id


T = TypeVar("T")


def set_or(value: T | UnsetType, default: T) -> T:
    """The value of an optional key."""
    return default if isinstance(value, UnsetType) else value
