"""What can be wrong with a stream of measurements, found without looking at their meaning."""

from __future__ import annotations

from typing import Annotated

import msgspec

Positive = Annotated[float, msgspec.Meta(gt=0)]


class SensorsConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """When a stream is called faulty."""

    gap_periods: Positive = 3.5  # between two stamps, in periods of the topic
    bad_share: Annotated[float, msgspec.Meta(ge=0, le=1)] = 0.05  # of values that are not finite
    min_points: Annotated[int, msgspec.Meta(ge=0)] = 100  # in a sweep
    repeat_s: Positive = 5.0  # one kind of fault is told again only after


class StreamGuard:
    """One stream: feed it each stamp, and ask it now and then whether it fell silent, for `deadline_s` or more."""

    def __init__(self, name: str, rate_hz: float, config: SensorsConfig, *, deadline_s: float = 0.0) -> None:
        self.name = name
        self.faults = 0
        self._config = config
        self._period_ns = 1e9 / rate_hz
        self._silent_ns = max(config.gap_periods * self._period_ns, 1e9 * deadline_s)
        self._newest_ns: int | None = None
        self._told_ns: dict[str, int] = {}

    def check(self, stamp_ns: int, *, bad_share: float = 0.0, shortage: str = "") -> list[str]:
        """Faults of one message that are worth telling; `shortage` is a finding of the caller."""
        found = [("shortage", shortage)] if shortage else []
        if self._newest_ns is not None:
            step_s = (stamp_ns - self._newest_ns) * 1e-9
            if step_s <= 0:
                found.append(("order", f"{self.name}: stamp {abs(step_s):.3f} s behind the one before"))
            elif step_s * 1e9 > self._config.gap_periods * self._period_ns:
                found.append(("gap", f"{self.name}: nothing for {step_s:.3f} s"))
        if bad_share > self._config.bad_share:
            found.append(("bad", f"{self.name}: {100 * bad_share:.0f} % of the values are not finite"))
        self._newest_ns = max(stamp_ns, self._newest_ns or stamp_ns)
        return self._new(found, stamp_ns)

    def silence(self, now_ns: int) -> list[str]:
        """A fault if a stream that once spoke is silent."""
        if self._newest_ns is None or now_ns - self._newest_ns <= self._silent_ns:
            return []
        found = [("silence", f"{self.name}: silent since {(now_ns - self._newest_ns) * 1e-9:.2f} s")]
        return self._new(found, now_ns)

    def _new(self, found: list[tuple[str, str]], now_ns: int) -> list[str]:
        self.faults += len(found)
        told = []
        for kind, text in found:
            last_ns = self._told_ns.get(kind)
            if last_ns is None or not 0 <= now_ns - last_ns < self._config.repeat_s * 1e9:
                self._told_ns[kind] = now_ns
                told.append(text)
        return told
