"""Asks the autopilot for something until it is so, a bounded number of times."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from companion.core.messages import CommandResult, VehicleCommand

Kind = Literal["arm", "disarm", "offboard", "hold", "land", "return"]


@dataclass(slots=True)
class Requests:
    """At most `attempts` commands of one kind in a row: again `retry_ns` after a refusal, or when
    nothing came of the last within `answer_ns` (the autopilot node itself repeats what gets lost)."""

    retry_ns: int
    answer_ns: int
    attempts: int
    kind: str = ""
    count: int = 0
    sent_ns: int = 0
    refused_ns: int | None = None
    refusal: str = ""  # newest reason of the autopilot

    def ask(self, kind: Kind, now_ns: int) -> VehicleCommand | None:
        """The command to send now, if one is due; another kind starts counting anew."""
        if kind != self.kind:
            self.reset()
            self.kind = kind
        if self.count >= self.attempts or (self.count and not self._spent(now_ns)):
            return None
        self.count, self.sent_ns, self.refused_ns = self.count + 1, now_ns, None
        return VehicleCommand(stamp_ns=now_ns, kind=kind)

    def heard(self, result: CommandResult) -> None:
        """Remember that and why it was refused."""
        if result.kind == self.kind and not result.accepted:
            self.refused_ns, self.refusal = result.stamp_ns, result.reason or "no reason given"

    def exhausted(self, now_ns: int) -> bool:
        """All attempts sent, and the last had its time."""
        return self.count >= self.attempts and self._spent(now_ns)

    def reset(self) -> None:
        """Start counting anew."""
        self.kind, self.count, self.refused_ns, self.refusal = "", 0, None, ""

    def _spent(self, now_ns: int) -> bool:
        if self.refused_ns is not None and now_ns - self.refused_ns >= self.retry_ns:
            return True
        return now_ns - self.sent_ns >= self.answer_ns
