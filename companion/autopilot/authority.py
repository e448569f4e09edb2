"""Whose flight it is. The pilot always wins: what he changed, we do not change back.

We own the flight from the moment when a mode that we asked for came. If another mode comes that
we did not ask for, somebody took over: the pilot, a ground station, or the autopilot's own
failsafe. From then on every command of ours is refused, and setpoints stop, so that PX4 refuses
OFFBOARD ("no offboard signal") instead of flying to a place that we wanted long ago. That ends when
the vehicle disarms; on the ground, where nothing can be seen to end, RELEASE_S later.
"""

from __future__ import annotations

from typing import Final

RELEASE_S: Final = 15.0  # longer than a mission goes on asking
MODE_OF: Final[dict[str, str]] = {"offboard": "OFFBOARD", "hold": "HOLD", "land": "LAND", "return": "RETURN"}
_FOLLOWS: Final[dict[str, tuple[str, ...]]] = {"RETURN": ("LAND",)}  # where a mode leads by itself


class Authority:
    """Tell it what was asked and every state that the autopilot reports."""

    def __init__(self) -> None:
        self._wanted = ""  # the mode that we asked for last, '' if none
        self._before = ""  # the mode at that time
        self._reached = False
        self._armed = False
        self._taken_ns: int | None = None
        self.reason = ""  # why it is not ours any more; '' if nobody took over

    @property
    def flying(self) -> bool:
        """We fly it: it is armed, and nobody changed what we asked for."""
        return self._armed and bool(self._wanted)

    def asked(self, kind: str, mode: str) -> None:
        """We command a mode while the vehicle is in `mode`."""
        if kind in MODE_OF:
            self._wanted, self._before = MODE_OF[kind], mode
            self._reached = mode == self._wanted

    def refused(self, kind: str) -> None:
        """The autopilot did not do it; what it does now is not ours unless it was before."""
        if not self._armed and not self._reached and MODE_OF.get(kind) == self._wanted:
            self._wanted = ""

    def saw(self, mode: str, *, armed: bool, now_ns: int) -> bool:
        """One report of the autopilot; true if somebody took over just now."""
        self._follow_arming(armed, now_ns)
        if not self._wanted or self.reason:
            return False
        if mode == self._wanted or mode in _FOLLOWS.get(self._wanted, ()):
            self._reached = True
            return False
        if not self._reached and mode == (self._before or mode):
            self._before = mode
            return False
        self._wanted, self._reached, self._taken_ns = "", False, now_ns
        self.reason = f"the pilot or the autopilot took over: mode {mode}"
        return True

    def _follow_arming(self, armed: bool, now_ns: int) -> None:
        landed = self._armed and not armed
        waited = self._taken_ns is not None and now_ns - self._taken_ns > RELEASE_S * 1e9
        self._armed = armed
        if landed or (waited and not armed):
            self.restart()

    def restart(self) -> None:
        """The flight is over: whatever was asked before counts no more."""
        self._wanted, self._before, self._reached = "", "", False
        self._taken_ns, self.reason = None, ""


def fulfilled(mode: str, *, armed: bool) -> list[str]:
    """Kinds of commands that ask for what the vehicle already is."""
    return ["arm" if armed else "disarm", *(kind for kind, of_kind in MODE_OF.items() if of_kind == mode)]
