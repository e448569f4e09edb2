"""Maps the autopilot's clock to ours over TIMESYNC.

The filter is PX4's: double exponential smoothing of (offset, drift per sample) whose gains
fall along a sigmoid while it converges, a gate on the round trip, and a reset after a run
of outliers, which means that a clock jumped.
Sources: mavlink.io/en/services/timesync.html; the constants of PX4 src/lib/timesync.
"""

from __future__ import annotations

import math
from typing import Annotated

import msgspec

from companion.autopilot.codec import Timesync

_Gain = Annotated[float, msgspec.Meta(gt=0, le=1)]


class TimesyncConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Gains and gates of the filter; one sample is one answered request."""

    convergence_samples: Annotated[int, msgspec.Meta(ge=2)] = 500
    """Samples until the offset is trusted: 50 s at 10 Hz."""
    rtt_max_ms: Annotated[float, msgspec.Meta(gt=0)] = 10.0
    """Slower round trips say too little about the offset and are dropped."""
    outlier_ms: Annotated[float, msgspec.Meta(gt=0)] = 100.0
    """A sample farther off than this, once converged, is an outlier."""
    outliers_max: Annotated[int, msgspec.Meta(ge=1)] = 10
    """More outliers than this in a row: a clock jumped, start anew."""
    gain_initial: _Gain = 0.05
    """Smoothing of offset and drift at the first sample."""
    gain_final: _Gain = 0.003
    """Smoothing of offset and drift once converged."""


class TimesyncFilter:
    """Offset companion minus autopilot clock; `learn` from each answer, then convert stamps."""

    def __init__(self, config: TimesyncConfig) -> None:
        self._config = config
        self.restart()

    def restart(self) -> None:
        """Forget everything: the other clock started anew."""
        self._samples = 0
        self._base_ns = 0  # the first offset, exact; floats hold only the rest
        self._rest_ns = 0.0
        self._drift_ns = 0.0  # per sample
        self._outliers = 0

    @property
    def converged(self) -> bool:
        """Enough samples went in to trust the offset."""
        return self._samples >= self._config.convergence_samples

    @property
    def offset_ns(self) -> int:
        """Companion clock minus autopilot clock."""
        return self._base_ns + round(self._rest_ns)

    def to_companion(self, autopilot_ns: int) -> int | None:
        """An autopilot stamp on our clock; None until converged."""
        return autopilot_ns + self.offset_ns if self.converged else None

    def to_autopilot(self, companion_ns: int) -> int | None:
        """One of our stamps on the autopilot's clock; None until converged."""
        return companion_ns - self.offset_ns if self.converged else None

    def learn(self, answer: Timesync, now_ns: int) -> None:
        """Take in an answer to our request of time `ts1` that arrived now.

        The offset assumes equal travel times: the autopilot's clock was read halfway.
        """
        round_trip_ns = now_ns - answer.ts1
        if not 0 <= round_trip_ns <= self._config.rtt_max_ms * 1e6:
            return
        offset_ns = answer.ts1 + round_trip_ns // 2 - answer.tc1
        if self.converged and abs(offset_ns - self.offset_ns) > self._config.outlier_ms * 1e6:
            self._outliers += 1
            if self._outliers > self._config.outliers_max:
                self.restart()
            return
        self._outliers = 0
        self._smooth(offset_ns)
        self._samples += 1

    def _smooth(self, offset_ns: int) -> None:
        if self._samples == 0:
            self._base_ns = offset_ns
            return
        gain, before = self._gain(), self._rest_ns
        self._rest_ns = gain * (offset_ns - self._base_ns) + (1 - gain) * (before + self._drift_ns)
        self._drift_ns = gain * (self._rest_ns - before) + (1 - gain) * self._drift_ns

    def _gain(self) -> float:
        config = self._config
        if self.converged:
            return config.gain_final
        remaining = 1 - self._samples / config.convergence_samples
        settled = 1 - math.exp(0.5 * (1 - 1 / remaining))
        return settled * config.gain_final + (1 - settled) * config.gain_initial


def request(now_ns: int) -> Timesync:
    """Ask the other side for its clock."""
    return Timesync(tc1=0, ts1=now_ns)


def answer(asked: Timesync, now_ns: int) -> Timesync:
    """Answer the other side with our clock; 0 would read as a request."""
    return Timesync(tc1=max(now_ns, 1), ts1=asked.ts1)
