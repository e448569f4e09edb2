"""Rate, bandwidth and delay of a topic over a window of its newest samples."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import Any

import numpy as np

from companion.core.errors import CompanionError
from companion.runtime.bus.gaps import Gaps
from companion.runtime.tools.ear import Heard
from companion.runtime.wire.parts import stamp_of

Report = dict[str, float]


class RateMeter:
    """Rate, and how even the periods between arrivals are."""

    def __init__(self, window: int = 10_000) -> None:
        self._periods_s: deque[float] = deque(maxlen=window)
        self._before_ns = 0
        self._gaps = Gaps()

    def add(self, heard: Heard) -> None:
        """One sample."""
        self._gaps.note(heard.attachment)
        if self._before_ns:
            self._periods_s.append((heard.monotonic_ns - self._before_ns) * 1e-9)
        self._before_ns = heard.monotonic_ns

    def report(self) -> Report:
        """`rate_hz`, periods in s, `window` periods, `lost` since the start; {} before the second sample."""
        if not self._periods_s:
            return {}
        return {
            "rate_hz": 1.0 / max(float(np.mean(self._periods_s)), 1e-9),
            **_spread(self._periods_s, "period", "s"),
            "window": len(self._periods_s),
            "lost": self._gaps.lost,
        }

    @staticmethod
    def line(report: Report) -> str:
        """As a user reads it."""
        return (
            f"average rate: {report['rate_hz']:.3f} Hz   period min {1e3 * report['period_min_s']:.2f} "
            f"max {1e3 * report['period_max_s']:.2f} std {1e3 * report['period_std_s']:.2f} ms   "
            f"window {report['window']:.0f}   lost {report['lost']:.0f}"
        )


class BandwidthMeter:
    """Bytes per second and sizes of payloads, without what Zenoh and TCP add."""

    def __init__(self, window: int = 100) -> None:
        self._sizes: deque[int] = deque(maxlen=window)
        self._times_ns: deque[int] = deque(maxlen=window + 1)
        self._gaps = Gaps()

    def add(self, heard: Heard) -> None:
        """One sample."""
        self._gaps.note(heard.attachment)
        self._sizes.append(len(heard.payload))
        self._times_ns.append(heard.monotonic_ns)

    def report(self) -> Report:
        """`bytes_per_s`, sizes in bytes; {} before the second sample."""
        span_s = (self._times_ns[-1] - self._times_ns[0]) * 1e-9 if len(self._times_ns) > 1 else 0.0
        if span_s <= 0.0:
            return {}
        timed = list(self._sizes)[-(len(self._times_ns) - 1) :]  # those with a time before them
        return {
            "bytes_per_s": sum(timed) / span_s,
            "size_mean_bytes": float(np.mean(self._sizes)),
            "size_min_bytes": min(self._sizes),
            "size_max_bytes": max(self._sizes),
            "window": len(self._sizes),
            "lost": self._gaps.lost,
        }

    @staticmethod
    def line(report: Report) -> str:
        """As a user reads it."""
        mean, low, high = (size_text(report[f"size_{key}_bytes"]) for key in ("mean", "min", "max"))
        return (
            f"{size_text(report['bytes_per_s'])}/s from {report['window']:.0f} messages   "
            f"size mean {mean} min {low} max {high}   lost {report['lost']:.0f}"
        )


class DelayMeter:
    """Age at arrival: of the header's stamp (when it was measured), and since the sender sent it."""

    def __init__(self, decode: Callable[[bytes], dict[str, Any]], window: int = 10_000) -> None:
        self._decode = decode
        self._stamped_s: deque[float] = deque(maxlen=window)
        self._sent_s: deque[float] = deque(maxlen=window)

    def add(self, heard: Heard) -> None:
        """One sample; CompanionError if its type has no header."""
        stamp = stamp_ns_of(self._decode(heard.payload))
        self._stamped_s.append((heard.wall_ns - stamp) * 1e-9)
        if heard.attachment is not None and heard.attachment.source_ns > 0:
            self._sent_s.append((heard.wall_ns - heard.attachment.source_ns) * 1e-9)

    def report(self) -> Report:
        """Ages in s; those since sending are missing if the sender does not say when."""
        if not self._stamped_s:
            return {}
        sent = _spread(self._sent_s, "sent", "s", mean=True) if self._sent_s else {}
        return {**_spread(self._stamped_s, "stamp", "s", mean=True), **sent, "window": len(self._stamped_s)}

    @staticmethod
    def line(report: Report) -> str:
        """As a user reads it."""
        parts = [
            f"average delay {since}: {1e3 * report[f'{key}_mean_s']:.2f} ms   min {1e3 * report[f'{key}_min_s']:.2f} "
            f"max {1e3 * report[f'{key}_max_s']:.2f} std {1e3 * report[f'{key}_std_s']:.2f}"
            for key, since in (("stamp", "since stamp"), ("sent", "since sending"))
            if f"{key}_mean_s" in report
        ]
        return "   ".join((*parts, f"window {report['window']:.0f}"))


Meter = RateMeter | BandwidthMeter | DelayMeter


def stamp_ns_of(value: dict[str, Any]) -> int:
    """Of `header.stamp`; CompanionError if there is none."""
    try:
        return stamp_of(value["header"])
    except KeyError:
        raise CompanionError("the type has no header with a stamp: its delay cannot be measured") from None


def size_text(count: float) -> str:
    """Bytes with a unit of powers of 1000."""
    for unit, scale in (("MB", 1e6), ("kB", 1e3)):
        if count >= scale:
            return f"{count / scale:.2f} {unit}"
    return f"{count:.0f} B"


def _spread(values: deque[float], what: str, unit: str, *, mean: bool = False) -> Report:
    first = {f"{what}_mean_{unit}": float(np.mean(values))} if mean else {}
    spread = {"min": min(values), "max": max(values), "std": float(np.std(values))}
    return first | {f"{what}_{key}_{unit}": figure for key, figure in spread.items()}
