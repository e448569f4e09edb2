"""What a stored mission is made of: MISSION_ITEM_INT without its number.

Source: MAVLink mission protocol, MAV_CMD; heights are above home (MAV_FRAME_GLOBAL_RELATIVE_ALT_INT).
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

RELATIVE_HEIGHT: Final = 6  # MAV_FRAME
NO_FRAME: Final = 2  # MAV_FRAME_MISSION
WAYPOINT, RETURN, LAND, TAKEOFF, DELAY, CHANGE_SPEED = 16, 20, 21, 22, 93, 178  # MAV_CMD
NAMES: Final = {
    WAYPOINT: "fly to", RETURN: "return", LAND: "land", TAKEOFF: "take off", DELAY: "wait", CHANGE_SPEED: "speed",
}  # fmt: skip
_GROUND_SPEED: Final = 1.0  # of CHANGE_SPEED's first parameter
_UNCHANGED: Final = -1.0


class MissionItem(NamedTuple):
    """One item; x and y are latitude and longitude in 1e-7 degrees where the frame has places."""

    frame: int
    command: int
    params: tuple[float, float, float, float]
    x: int = 0
    y: int = 0
    z: float = 0.0


def at_place(command: int, latitude_deg: float, longitude_deg: float, height_m: float) -> MissionItem:
    """Take off to, or fly to, a place; the nose as the autopilot likes."""
    x, y = round(latitude_deg * 1e7), round(longitude_deg * 1e7)
    return MissionItem(RELATIVE_HEIGHT, command, (0.0, 0.0, 0.0, math.nan), x, y, height_m)


def wait(seconds: float) -> MissionItem:
    """Stay."""
    return MissionItem(NO_FRAME, DELAY, (seconds, _UNCHANGED, _UNCHANGED, _UNCHANGED))


def fly_at(speed: float) -> MissionItem:
    """From here on, m/s over ground."""
    return MissionItem(NO_FRAME, CHANGE_SPEED, (_GROUND_SPEED, speed, _UNCHANGED, 0.0))


def go_home() -> MissionItem:
    """Back to where it took off, and down."""
    return MissionItem(NO_FRAME, RETURN, (0.0, 0.0, 0.0, 0.0))


def described(item: MissionItem) -> str:
    """As a user reads it."""
    name = NAMES.get(item.command, f"command {item.command}")
    if item.command in (WAYPOINT, TAKEOFF, LAND) and item.frame != NO_FRAME:
        return f"{name} {item.x * 1e-7:.7f}, {item.y * 1e-7:.7f}, {item.z:g} m up"
    if item.command == DELAY:
        return f"{name} {item.params[0]:g} s"
    return f"{name} {item.params[1]:g} m/s" if item.command == CHANGE_SPEED else name
