"""One flight in lockstep: steps the nodes until the mission has ended, and says how."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

from companion.config import LockstepConfig
from companion.core import topics
from companion.core.messages import GroundTruth, MissionStatus
from companion.core.node import Node, Topic
from companion.runtime.flight_log import FlightLog
from companion.runtime.lockstep import Lockstep

STEP_NS = 100_000_000


class Listener(Protocol):
    """Hears every message of a flight."""

    def heard(self, topic: Topic[Any], message: Any) -> None:
        """One message was published."""


@dataclass(frozen=True, slots=True)
class Progress:
    """Where a flight is."""

    time_s: float
    truth: GroundTruth | None
    mission: MissionStatus | None


@dataclass(frozen=True, slots=True)
class Ending:
    """How a flight ended."""

    completed: bool
    reason: str
    contact: str


class Flight:
    """Nodes in lockstep; iterate `run` for progress, then ask `ending`."""

    def __init__(
        self, nodes: Sequence[Node], config: LockstepConfig, *, log: FlightLog, listeners: Sequence[Listener]
    ) -> None:
        delays_ns = {n: {k: round(v * 1e6) for k, v in d.items()} for n, d in config.delay_ms.items()}
        self._tee = _Tee(log, [self, *listeners])
        self.lockstep = Lockstep(nodes, delays_ns=delays_ns, tap=self._tee)
        self._truth: GroundTruth | None = None
        self._mission: MissionStatus | None = None
        self._touched = ""

    def heard(self, topic: Topic[Any], message: Any) -> None:
        """Follow the truth and the mission."""
        if topic is topics.TRUTH:
            self._truth = message
            self._touched = self._touched or message.contact
        elif topic is topics.MISSION:
            self._mission = message

    def run(self, *, limit_s: float) -> Iterator[Progress]:
        """Step until the mission is over, something is touched, or `limit_s` is reached; once."""
        try:
            while self.lockstep.now_ns < limit_s * 1e9 and not self._over():
                self.lockstep.run_until(self.lockstep.now_ns + STEP_NS)
                yield Progress(self.lockstep.now_ns * 1e-9, self._truth, self._mission)
        finally:
            self.lockstep.settle()

    def ending(self, *, limit_s: float) -> Ending:
        """What came out of it."""
        if self._touched:
            return Ending(False, f"touched {self._touched}", self._touched)
        if self._mission is None:
            return Ending(False, "the mission never started", "")
        if self._mission.state == "done":
            return Ending(True, "", "")
        if self._mission.state == "failed":
            return Ending(False, self._mission.reason, "")
        return Ending(False, f"not done after {limit_s:g} s, in step {self._mission.step_id}", "")

    def _over(self) -> bool:
        if self._touched:
            return True
        ended = self._mission is not None and self._mission.state in ("done", "failed")
        return ended and self._truth is not None and not self._truth.armed


class _Tee:
    """The log first, then whoever else listens."""

    def __init__(self, log: FlightLog, listeners: Sequence[Listener]) -> None:
        self._log, self._listeners = log, listeners

    def published(self, now_ns: int, source: str, topic: Topic[Any], message: Any) -> int:
        for listener in self._listeners:
            listener.heard(topic, message)
        return self._log.published(now_ns, source, topic, message)

    def fed(self, now_ns: int, node: str, event: str, number: int) -> None:
        self._log.fed(now_ns, node, event, number)
