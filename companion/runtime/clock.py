"""The clock of a running stack: one for all its processes, and it never steps back."""

from __future__ import annotations

import time
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Clock:
    """Host time as the monotonic clock plus an offset that is fixed once; from `since_ns` on at `speed`.

    A step of the host's clock (NTP, GPS) then moves no stamp: all processes of a flight share the
    offset, and the monotonic clock is the same for every process of a host. Another speed than 1 is
    for flying with a simulator that is not in real time.
    """

    offset_ns: int
    speed: float = 1.0
    since_ns: int = 0

    @classmethod
    def of_host(cls) -> Clock:
        """Read the offset from the host's clock, now."""
        return cls(time.time_ns() - time.monotonic_ns())

    def now_ns(self) -> int:
        """Nanoseconds since 1970, on this clock."""
        return self.shown_ns(time.monotonic_ns() + self.offset_ns)

    def shown_ns(self, host_ns: int) -> int:
        """What this clock shows at a time of the host."""
        if self.speed == 1.0:
            return host_ns
        return self.since_ns + round((host_ns - self.since_ns) * self.speed)

    def wait_s(self, until_ns: int) -> float:
        """How long to wait for a time of this clock, in the world's seconds."""
        return (until_ns - self.now_ns()) * 1e-9 / self.speed
