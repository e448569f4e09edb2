"""The wall clock of a running stack: one epoch for all its processes, and it never steps back."""

from __future__ import annotations

import time
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Clock:
    """Host time as the monotonic clock plus an offset that is fixed once.

    A step of the host's clock (NTP, GPS) then moves no stamp: all processes of a flight share the
    offset, and the monotonic clock is the same for every process of a host.
    """

    offset_ns: int

    @classmethod
    def of_host(cls) -> Clock:
        """Read the offset from the host's clock, now."""
        return cls(time.time_ns() - time.monotonic_ns())

    def now_ns(self) -> int:
        """Nanoseconds since 1970."""
        return time.monotonic_ns() + self.offset_ns
