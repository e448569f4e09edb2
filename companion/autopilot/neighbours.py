"""Whether somebody else speaks under our own address: a second companion on the same link."""

from __future__ import annotations

from collections import deque
from typing import Final

ABSENT_S: Final = 5.0
LISTEN_S: Final = 2.0  # heartbeats come at 1 Hz
ECHOES: Final = 4  # heartbeats of ours that a router may send back to us


class Neighbours:
    """Feed it the sequence numbers of our heartbeats, and of those heard under our address."""

    def __init__(self, *, system: int, component: int) -> None:
        self._name = f"{system}/{component}"
        self._sent: deque[int] = deque(maxlen=ECHOES)
        self._heard_ns: int | None = None
        self._since_ns: int | None = None

    def sent(self, sequence: int) -> None:
        """We sent a heartbeat with this number."""
        self._sent.append(sequence)

    def heard(self, sequence: int, now_ns: int) -> bool:
        """A heartbeat under our address; true if it is news that somebody is there.

        One with the number of a recent heartbeat of ours is our own, sent back.
        """
        if sequence in self._sent:
            return False
        news = not self.present(now_ns)
        self._heard_ns = now_ns
        return news

    def present(self, now_ns: int) -> bool:
        """Somebody was heard within the last ABSENT_S."""
        return self._heard_ns is not None and now_ns - self._heard_ns <= ABSENT_S * 1e9

    @property
    def reason(self) -> str:
        """What to say when there is one."""
        return f"another companion ({self._name}) speaks on this link"

    def listened(self, now_ns: int, *, connected: bool) -> bool:
        """We have been connected long enough to have heard one."""
        if not connected:
            self._since_ns = None
            return False
        if self._since_ns is None:
            self._since_ns = now_ns
        return now_ns - self._since_ns >= LISTEN_S * 1e9
