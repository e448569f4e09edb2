"""Put scans and images back into the order of their stamps, waiting no longer than needed."""

from __future__ import annotations

import heapq
from dataclasses import dataclass, field
from typing import Annotated, Generic, TypeVar

import msgspec

M = TypeVar("M")
Positive = Annotated[float, msgspec.Meta(gt=0)]
_SILENT_AFTER_PERIODS = 3
_AHEAD_NS = 1_000_000_000


class OrderConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """How long a measurement waits for an earlier one of another sensor that is still due."""

    hold_back_s: Positive = 0.05  # at most, against the newest IMU stamp
    lidar_period_s: Positive = 0.1
    camera_period_s: Positive = 1 / 15


@dataclass(slots=True)
class _Stream:
    period_ns: int
    newest_ns: int | None = None

    def may_bring_earlier_than(self, stamp_ns: int) -> bool:
        """Whether its next message, still under way, could be older than `stamp_ns`."""
        if self.newest_ns is None:
            return False
        due = self.newest_ns + self.period_ns * 9 // 10
        silent = stamp_ns - self.newest_ns > _SILENT_AFTER_PERIODS * self.period_ns
        return due < stamp_ns and not silent


@dataclass(slots=True)
class Reorder(Generic[M]):
    """Takes messages of several streams and releases them in stamp order.

    A message is released once the IMU reaches its stamp and no other live stream can bring an
    older one, or after the hold-back. What comes too late, or twice, is dropped and counted.
    """

    hold_back_ns: int
    periods_ns: dict[str, int]
    dropped: int = 0
    _streams: dict[str, _Stream] = field(default_factory=dict)
    _waiting: list[tuple[int, int, str, M]] = field(default_factory=list)
    _released_ns: int = -(2**62)
    _sequence: int = 0

    def __post_init__(self) -> None:
        self._streams = {name: _Stream(period) for name, period in self.periods_ns.items()}

    def put(self, stream: str, stamp_ns: int, message: M, *, now_ns: int) -> None:
        """Queue a message; dropped if too late, if its stream ran backward, or if stamped far ahead."""
        source = self._streams[stream]
        backward = source.newest_ns is not None and stamp_ns <= source.newest_ns
        if backward or stamp_ns < self._released_ns or stamp_ns > now_ns + _AHEAD_NS:
            self.dropped += 1
            return
        source.newest_ns = stamp_ns
        self._sequence += 1
        heapq.heappush(self._waiting, (stamp_ns, self._sequence, stream, message))

    def take(self, now_ns: int) -> M | None:
        """The next message that is due, `now_ns` being the newest IMU stamp; None: wait."""
        if not self._waiting:
            return None
        stamp_ns, _, stream, message = self._waiting[0]
        if stamp_ns > now_ns:
            return None
        others = (s for name, s in self._streams.items() if name != stream)
        if now_ns - stamp_ns < self.hold_back_ns and any(s.may_bring_earlier_than(stamp_ns) for s in others):
            return None
        heapq.heappop(self._waiting)
        self._released_ns = stamp_ns
        return message

    @property
    def waiting(self) -> int:
        """How many are held."""
        return len(self._waiting)
