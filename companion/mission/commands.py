"""Asks the autopilot for something until it is so, a bounded number of times."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from companion.core.messages import CommandResult, VehicleCommand

Kind = Literal["arm", "disarm", "offboard", "hold", "land", "return"]


@dataclass(slots=True)
class Requests:
    """At most `attempts` commands of one kind in a row, `retry_ns` apart."""

    retry_ns: int
    attempts: int
    kind: str = ""
    count: int = 0
    sent_ns: int = 0
    refusal: str = ""  # newest reason of the autopilot

    def ask(self, kind: Kind, now_ns: int) -> VehicleCommand | None:
        """The command to send now, if one is due; another kind starts counting anew."""
        if kind != self.kind:
            self.kind, self.count, self.refusal = kind, 0, ""
        if self.count >= self.attempts or (self.count and now_ns - self.sent_ns < self.retry_ns):
            return None
        self.count, self.sent_ns = self.count + 1, now_ns
        return VehicleCommand(stamp_ns=now_ns, kind=kind)

    def heard(self, result: CommandResult) -> None:
        """Remember why it was refused."""
        if result.kind == self.kind:
            self.refusal = "" if result.accepted else result.reason or "no reason given"

    def exhausted(self, now_ns: int) -> bool:
        """All attempts sent, and the last had its time."""
        return self.count >= self.attempts and now_ns - self.sent_ns >= self.retry_ns

    def reset(self) -> None:
        """Start counting anew."""
        self.kind, self.count, self.refusal = "", 0, ""
