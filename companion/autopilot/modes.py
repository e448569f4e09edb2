"""Flight modes and mode commands of PX4 and ArduCopter in the stack's words.

Sources: PX4 src/modules/commander/px4_custom_mode.h; ArduCopter mode.h; MAV_CMD.
"""

from __future__ import annotations

from typing import Final, Literal

from companion.autopilot.codec import CommandLong

Flavour = Literal["px4", "ardupilot"]

ARM_DISARM: Final = 400  # MAV_CMD_COMPONENT_ARM_DISARM
SET_MODE: Final = 176  # MAV_CMD_DO_SET_MODE
SET_INTERVAL: Final = 511  # MAV_CMD_SET_MESSAGE_INTERVAL
AUTOPILOT_ARDUPILOT: Final = 3  # MAV_AUTOPILOT_ARDUPILOTMEGA

_PX4_AUTO: Final = 4
_PX4_MAIN: Final = {
    1: "MANUAL",
    2: "ALTITUDE",
    3: "POSITION",
    5: "ACRO",
    6: "OFFBOARD",
    7: "STABILIZED",
    8: "RATTITUDE",
    10: "TERMINATION",
    11: "ALTITUDE_CRUISE",
}
_PX4_SUB: Final = {
    1: "READY",
    2: "TAKEOFF",
    3: "HOLD",
    4: "MISSION",
    5: "RETURN",
    6: "LAND",
    8: "FOLLOW",
    9: "PRECISION_LAND",
    10: "VTOL_TAKEOFF",
}
_ARDUCOPTER: Final = {
    0: "STABILIZED",
    1: "ACRO",
    2: "ALTITUDE",
    3: "MISSION",
    4: "OFFBOARD",  # GUIDED
    5: "LOITER",
    6: "RETURN",
    7: "CIRCLE",
    9: "LAND",
    11: "DRIFT",
    13: "SPORT",
    14: "FLIP",
    15: "AUTOTUNE",
    16: "POSITION",
    17: "HOLD",  # BRAKE: LOITER would read the throttle stick
    18: "THROW",
    20: "GUIDED_NOGPS",
    21: "SMART_RETURN",
    23: "FOLLOW",
}
# kind of VehicleCommand -> (param2, param3) of DO_SET_MODE
_MODE_PARAMS: Final[dict[Flavour, dict[str, tuple[int, int]]]] = {
    "px4": {"offboard": (6, 0), "hold": (4, 3), "return": (4, 5), "land": (4, 6)},
    "ardupilot": {"offboard": (4, 0), "hold": (17, 0), "return": (6, 0), "land": (9, 0)},
}


def mode_name(custom_mode: int, flavour: Flavour) -> str:
    """HEARTBEAT.custom_mode -> OFFBOARD, HOLD, TAKEOFF, LAND, RETURN, ...; numbers if unknown."""
    if flavour == "ardupilot":
        return _ARDUCOPTER.get(custom_mode, f"MODE_{custom_mode}")
    main, sub = custom_mode >> 16 & 0xFF, custom_mode >> 24 & 0xFF
    if main == _PX4_AUTO:
        return _PX4_SUB.get(sub, f"AUTO_{sub}")
    return _PX4_MAIN.get(main, f"MODE_{main}")


def order(kind: str, flavour: Flavour, *, system: int, component: int) -> CommandLong:
    """The COMMAND_LONG of a VehicleCommand kind: arm, disarm, offboard, hold, land, return."""
    if kind in ("arm", "disarm"):
        return command_long(ARM_DISARM, float(kind == "arm"), system=system, component=component)
    main, sub = _MODE_PARAMS[flavour][kind]
    return command_long(SET_MODE, 1.0, main, sub, system=system, component=component)


def command_long(command: int, *params: float, system: int, component: int) -> CommandLong:
    """A COMMAND_LONG, first transmission; parameters not given are 0."""
    filled = (*params, *(0.0,) * (7 - len(params)))
    return CommandLong._make((*filled, command, system, component, 0))
