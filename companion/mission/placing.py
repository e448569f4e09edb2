"""Places goals: home, map and body frames -> odom, through the newest correction of odom in map."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from companion.core.correction import Correction
from companion.core.geometry import (
    quaternion_from_yaw,
    rotate,
    wrap_angle,
    yaw_of,
)
from companion.core.messages import Array, Odometry
from companion.mission.route import TURN_RAD, Leg


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Places:
    """What the frames of a step stand for, fixed when the step begins. Home has the axes of map."""

    p_map_home: Array  # where it armed, (3,)
    p_map_start: Array  # where the step began, (3,)
    yaw_map_start: float  # rad

    @classmethod
    def at(cls, odometry: Odometry, correction: Correction, p_map_home: Array) -> Places:
        """A step begins here."""
        yaw = yaw_of(odometry.q_odom_body) + correction.yaw
        p_map_start = correction.to_map(odometry.p_odom)
        return cls(p_map_home=p_map_home, p_map_start=p_map_start, yaw_map_start=yaw)

    def p_map(self, leg: Leg) -> Array:
        """The leg's goal in map, (3,)."""
        if leg.frame == "body":
            return self.p_map_start + rotate(quaternion_from_yaw(self.yaw_map_start), leg.p)
        return leg.p + (self.p_map_home if leg.frame == "home" else 0.0)

    def yaw_map(self, yaw: float | Literal["along_path", "hold", "turned"], frame: str) -> float:
        """Heading in map, rad; NaN: along the path."""
        if yaw == "along_path":
            return float("nan")
        if yaw == "hold":
            return self.yaw_map_start
        if yaw == "turned":
            return wrap_angle(self.yaw_map_start + TURN_RAD)
        return wrap_angle(yaw + (self.yaw_map_start if frame == "body" else 0.0))
