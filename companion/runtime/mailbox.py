"""What waits for a node: filled by any thread, emptied by the node's own."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from threading import Condition, Lock
from typing import Any

from companion.core.messages import freeze
from companion.core.node import Topic

LIMIT = 4096  # messages of "keep all" topics: 20 s of IMU for a node that hangs

_opening = Lock()


class Parcel:
    """A message on its way to one or more nodes of a process, decoded when the first opens it."""

    __slots__ = ("_decode", "_message", "_number", "topic")

    def __init__(
        self, topic: Topic[Any], message: Any, *, decode: Callable[[Any], Any] | None = None, number: int = -1
    ) -> None:
        self.topic = topic
        self._message, self._decode, self._number = message, decode, number

    def open(self, note: Callable[[Topic[Any], Any], int]) -> tuple[Any, int]:
        """(message, its number); `note` numbers a message that came from outside, once.

        Raises what `decode` raises.
        """
        with _opening:
            if self._decode is not None:
                self._message, self._decode = freeze(self._decode(self._message)), None
            if self._number < 0:
                self._number = note(self.topic, self._message)
        return self._message, self._number


class Bell:
    """Wakes the thread that empties some mailboxes; rung by any other."""

    def __init__(self) -> None:
        self.lock = Condition()
        self._rung = False
        self._waiting = False

    def ring(self) -> None:
        """Let a waiting `wait` return; call it with the lock held."""
        self._rung = True
        if self._waiting:
            self.lock.notify()

    def wait(self, timeout_s: float) -> None:
        """Return when rung since the last call, or after the time."""
        with self.lock:
            if not self._rung and timeout_s > 0:
                self._waiting = True
                self.lock.wait(timeout_s)
                self._waiting = False
            self._rung = False


class Mailbox:
    """A queue in which a newer message of a `keep="latest"` topic replaces the one that waits."""

    def __init__(self, bell: Bell, *, limit: int = LIMIT) -> None:
        self.dropped = 0  # replaced, or pushed out of a full box
        self._bell, self._limit = bell, limit
        self._waiting: deque[Parcel] = deque()

    def __len__(self) -> int:
        return len(self._waiting)

    def put(self, parcel: Parcel) -> None:
        """Add a message; never waits for the node."""
        with self._bell.lock:
            if parcel.topic.keep == "latest":
                kept = [p for p in self._waiting if p.topic is not parcel.topic]
                if len(kept) < len(self._waiting):
                    self.dropped += len(self._waiting) - len(kept)
                    self._waiting = deque(kept)
            elif len(self._waiting) >= self._limit:
                self._waiting.popleft()
                self.dropped += 1
            self._waiting.append(parcel)
            self._bell.ring()

    def take(self) -> Parcel | None:
        """The oldest message, or None."""
        with self._bell.lock:
            return self._waiting.popleft() if self._waiting else None
