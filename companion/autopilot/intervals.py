"""Which needed messages come too slowly, so that we must ask for them (MAV_CMD_SET_MESSAGE_INTERVAL)."""

from __future__ import annotations

from typing import Final

from companion.autopilot.modes import Flavour
from companion.autopilot.vehicle import Id

NEEDED_HZ: Final[dict[Flavour, dict[int, float]]] = {
    "px4": {
        Id.LOCAL_POSITION_NED: 30.0,
        Id.EXTENDED_SYS_STATE: 5.0,
        Id.SYS_STATUS: 2.0,
        Id.ESTIMATOR_STATUS: 1.0,
    },
    "ardupilot": {
        Id.LOCAL_POSITION_NED: 30.0,
        Id.EXTENDED_SYS_STATE: 5.0,
        Id.SYS_STATUS: 2.0,
        Id.EKF_STATUS_REPORT: 2.0,
    },
}
WINDOW_S: Final = 2


class Intervals:
    """Counts what comes in windows of 2 s of connection."""

    def __init__(self, requests_max: int, *, ticks_hz: int) -> None:
        """Ask at most `requests_max` times for each message; `missing` is called at `ticks_hz`."""
        self._requests_max, self._window = requests_max, WINDOW_S * ticks_hz
        self.restart()

    def restart(self) -> None:
        """Another autopilot, or the same after a reboot: nothing was asked of it yet."""
        self._ticks = 0
        self._counts: dict[int, int] = {}
        self._requests: dict[int, int] = {}

    def heard(self, msg_id: int) -> None:
        """One message came."""
        self._counts[msg_id] = self._counts.get(msg_id, 0) + 1

    def missing(self, flavour: Flavour, connected: bool) -> list[tuple[int, float]]:
        """One tick: (id, rate in Hz) of what came at less than half its rate."""
        if not connected:
            self.restart()
            return []
        self._ticks += 1
        if self._ticks % self._window:
            return []
        slow: list[tuple[int, float]] = []
        for msg_id, hz in NEEDED_HZ[flavour].items():
            asked = self._requests.get(msg_id, 0)
            if self._counts.get(msg_id, 0) < 0.5 * hz * WINDOW_S and asked < self._requests_max:
                self._requests[msg_id] = asked + 1
                slow.append((msg_id, hz))
        self._counts = {}
        return slow
