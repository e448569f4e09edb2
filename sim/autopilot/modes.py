"""PX4's flight modes, their numbers on the wire, and the result codes of commands."""

from __future__ import annotations

from enum import Enum, IntEnum


class Mode(Enum):
    """Name -> (main mode, sub mode) of PX4's custom_mode; DESCEND shows as LAND, as on PX4."""

    MANUAL = (1, 0, "manual")
    POSCTL = (3, 0, "position")
    TAKEOFF = (4, 2, "takeoff")
    HOLD = (4, 3, "hold")
    MISSION = (4, 4, "mission")
    RETURN = (4, 5, "return")
    LAND = (4, 6, "land")
    OFFBOARD = (6, 0, "offboard")
    DESCEND = (4, 6, "descend")

    @property
    def custom_mode(self) -> int:
        """The 32-bit field of HEARTBEAT."""
        return self.value[1] << 24 | self.value[0] << 16

    @property
    def automatic(self) -> bool:
        """Flown by the autopilot's own guidance."""
        return self not in (Mode.MANUAL, Mode.POSCTL, Mode.OFFBOARD)

    @property
    def lands(self) -> bool:
        """Goes down to the ground."""
        return self in (Mode.LAND, Mode.DESCEND)


BY_NUMBERS = {mode.value[:2]: mode for mode in Mode if mode is not Mode.DESCEND}


class Result(IntEnum):
    """MAV_RESULT."""

    ACCEPTED = 0
    TEMPORARILY_REJECTED = 1
    DENIED = 2
    UNSUPPORTED = 3
    FAILED = 4


class Severity(IntEnum):
    """MAV_SEVERITY of a STATUSTEXT."""

    EMERGENCY = 0
    CRITICAL = 2
    WARNING = 4
    INFO = 6
