"""Commands that wait for their COMMAND_ACK.

Source: mavlink.io/en/services/command.html (retransmission with a rising confirmation,
MAV_RESULT).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final, NamedTuple

from companion.autopilot.codec import CommandLong

_ACCEPTED: Final = 0
_IN_PROGRESS: Final = 5
_RESULTS: Final = {
    1: "temporarily rejected",
    2: "denied",
    3: "not supported",
    4: "failed",
    6: "cancelled",
    7: "only as COMMAND_LONG",
    8: "only as COMMAND_INT",
    9: "frame not supported",
}


class Verdict(NamedTuple):
    """How a command ended."""

    kind: str
    accepted: bool
    reason: str


@dataclass(slots=True)
class _Waiting:
    kind: str
    request: CommandLong
    ticks: int = 0
    sent: int = 1


class CommandDesk:
    """One command per MAV_CMD waits at a time; a newer one with that number replaces it.

    Acknowledgements name only the MAV_CMD, so two waiting mode changes could not be told apart.
    """

    def __init__(self, *, ack_ticks: int, attempts: int) -> None:
        """Send again after `ack_ticks` ticks without answer, `attempts` times in all."""
        self._ack_ticks, self._attempts = ack_ticks, attempts
        self._waiting: dict[int, _Waiting] = {}

    def submit(self, kind: str, request: CommandLong) -> tuple[bool, Verdict | None]:
        """Whether to send it (not if the same one waits already), and the end of the one replaced."""
        old = self._waiting.get(request.command)
        if old and old.kind == kind:
            return False, None
        self._waiting[request.command] = _Waiting(kind, request)
        return True, Verdict(old.kind, False, f"replaced by {kind}") if old else None

    def acknowledge(self, ack: Any) -> Verdict | None:
        """Take a COMMAND_ACK; the verdict if it ends a waiting command."""
        waiting = self._waiting.get(ack.command)
        if waiting is None:
            return None
        if ack.result == _IN_PROGRESS:
            waiting.ticks = 0
            return None
        del self._waiting[ack.command]
        if ack.result == _ACCEPTED:
            return Verdict(waiting.kind, True, "")
        return Verdict(waiting.kind, False, _RESULTS.get(ack.result, f"result {ack.result}"))

    def fulfil(self, kind: str) -> Verdict | None:
        """What was asked is so: the answer may be lost, but nothing must be sent again."""
        for command, waiting in list(self._waiting.items()):
            if waiting.kind == kind:
                del self._waiting[command]
                return Verdict(kind, True, "")
        return None

    def cancel(self, reason: str) -> list[Verdict]:
        """Forget every waiting command, so that none is sent again; how they ended."""
        ended = [Verdict(waiting.kind, False, reason) for waiting in self._waiting.values()]
        self._waiting.clear()
        return ended

    def tick(self) -> tuple[list[CommandLong], list[Verdict]]:
        """One step of time: what to send again, and which commands ran out of attempts."""
        again: list[CommandLong] = []
        ended: list[Verdict] = []
        for command, waiting in list(self._waiting.items()):
            waiting.ticks += 1
            if waiting.ticks < self._ack_ticks:
                continue
            if waiting.sent >= self._attempts:
                del self._waiting[command]
                ended.append(Verdict(waiting.kind, False, "timeout"))
                continue
            again.append(waiting.request._replace(confirmation=waiting.sent))
            waiting.ticks, waiting.sent = 0, waiting.sent + 1
        return again, ended


def is_for(ack: object, system: int, component: int) -> bool:
    """Whether an acknowledgement addresses us; zero addresses everyone, as old autopilots do."""
    to_system, to_component = getattr(ack, "target_system", 0), getattr(ack, "target_component", 0)
    return to_system in (0, system) and to_component in (0, component)
