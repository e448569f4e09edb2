"""What we tell the pilot: STATUSTEXT in pieces, and which news are worth one.

Source: mavlink.io/en/messages/common.html#STATUSTEXT (50 characters per piece; a text of several
pieces has an id, rising chunk_seq, and ends with a piece that is not full).
"""

from __future__ import annotations

from enum import IntEnum
from typing import Final, NamedTuple

from companion.autopilot.codec import StatusText
from companion.core.messages import MissionStatus, SafetyStatus

PIECE: Final = 50
LENGTH_MAX: Final = 200
PREFIX: Final = "companion: "


class Severity(IntEnum):
    """MAV_SEVERITY."""

    CRITICAL = 2
    WARNING = 4
    INFO = 6


class News(NamedTuple):
    """One text for the pilot, without prefix."""

    severity: Severity
    text: str


def pieces(news: News, text_id: int) -> list[StatusText]:
    """The messages of a text; `text_id` (1..65535) only matters if it is long."""
    raw = f"{PREFIX}{news.text}".encode("ascii", "replace")[:LENGTH_MAX]
    if len(raw) <= PIECE:
        return [StatusText(news.severity, raw)]
    starts = range(0, len(raw) + 1, PIECE)  # one more, empty, if the last is full
    return [StatusText(news.severity, raw[at : at + PIECE], text_id, k) for k, at in enumerate(starts)]


class Newsroom:
    """Turns statuses into news when they change."""

    _SAFETY: Final = {"ok": Severity.INFO, "slow": Severity.WARNING, "hold": Severity.WARNING}
    _MISSION: Final = {"running": Severity.INFO, "failing": Severity.WARNING, "done": Severity.INFO}

    def __init__(self) -> None:
        self._action, self._state = "", "waiting"

    def safety(self, status: SafetyStatus) -> News | None:
        """The guards changed their action; the first word is no change."""
        before, self._action = self._action, status.action
        if not before or before == status.action:
            return None
        because = f": {status.reason}" if status.reason else ""
        return News(self._SAFETY.get(status.action, Severity.CRITICAL), f"safety {status.action}{because}")

    def mission(self, status: MissionStatus) -> News | None:
        """The mission changed its state."""
        before, self._state = self._state, status.state
        if before == status.state:
            return None
        because = f": {status.reason}" if status.reason else ""
        return News(self._MISSION.get(status.state, Severity.CRITICAL), f"mission {status.state}{because}")
