"""Companion time -> autopilot time, by PX4's double-exponential filter over TIMESYNC answers.

Until 500 answers have come, external stamps are replaced by the time of arrival. Source:
PX4 user guide, "Time synchronization"; constants observed (10 Hz, RTT <= 10 ms).
"""

from __future__ import annotations

import math
from typing import Final

WINDOW: Final = 500  # answers until the offset is trusted
GAIN_FIRST, GAIN_LAST = 0.05, 0.003
MAX_ROUND_TRIP_NS: Final = 10_000_000
MAX_DEVIATION_NS: Final = 100_000_000
MAX_OUTLIERS: Final = 10


class TimeSync:
    """Offset of the two clocks, learnt from our own requests as they come back."""

    def __init__(self) -> None:
        self.samples = 0
        self.resets = 0
        self._offset_ns = self._skew_ns = 0.0
        self._outliers = 0

    @property
    def converged(self) -> bool:
        """Whether stamps are translated rather than replaced."""
        return self.samples >= WINDOW

    def answer(self, now_ns: int, *, theirs_ns: int, ours_ns: int) -> None:
        """Our request of `ours_ns` came back now, stamped `theirs_ns` by the companion."""
        if not 0 <= now_ns - ours_ns <= MAX_ROUND_TRIP_NS:
            return
        offset = (ours_ns + now_ns) / 2 - theirs_ns
        if self.converged and abs(offset - self._offset_ns) > MAX_DEVIATION_NS:
            self._outliers += 1
            if self._outliers > MAX_OUTLIERS:
                self.samples = self._outliers = 0
                self.resets += 1
            return
        self._outliers = 0
        self._smooth(offset)
        self.samples += 1

    def to_autopilot(self, theirs_ns: int, now_ns: int) -> int:
        """A companion stamp in autopilot time; the time of arrival until the filter has converged."""
        return theirs_ns + round(self._offset_ns) if self.converged else now_ns

    def _smooth(self, offset_ns: float) -> None:
        if self.samples == 0:
            self._offset_ns, self._skew_ns = offset_ns, 0.0
            return
        left = 1.0 - min(self.samples, WINDOW) / WINDOW
        late = 1.0 - math.exp(0.5 * (1.0 - 1.0 / left)) if left > 0 else 1.0
        gain = late * GAIN_LAST + (1.0 - late) * GAIN_FIRST
        before = self._offset_ns
        self._offset_ns = gain * offset_ns + (1.0 - gain) * (before + self._skew_ns)
        self._skew_ns = gain * (self._offset_ns - before) + (1.0 - gain) * self._skew_ns
