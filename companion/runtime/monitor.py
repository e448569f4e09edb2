"""Watches a live flight on the bus: what the report needs, where the mission is, whether it is over."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from typing import Any, Protocol

from companion.core import topics
from companion.core.errors import CompanionError
from companion.core.messages import GroundTruth, MissionStatus, SafetyStatus, VehicleStatus
from companion.core.node import Topic
from companion.runtime.flight import Ending

WATCHED: tuple[Topic[Any], ...] = (
    topics.VEHICLE, topics.MISSION, topics.ODOMETRY, topics.PLAN, topics.SAFETY, topics.WHY, topics.TRUTH,
)  # fmt: skip
WAITING = 20_000  # 100 s of everything, if nobody looks


class Listener(Protocol):
    """Keeps what it wants of a flight."""

    def heard(self, topic: Topic[Any], message: Any) -> None:
        """One message."""


class Monitor:
    """Filled from the bus' threads, emptied by `look`."""

    def __init__(self, listeners: Sequence[Listener] = ()) -> None:
        self.vehicle: VehicleStatus | None = None
        self.mission: MissionStatus | None = None
        self.safety: SafetyStatus | None = None
        self.truth: GroundTruth | None = None
        self.flew = False
        self.contact = ""
        self._listeners = tuple(listeners)
        self._waiting: deque[tuple[Topic[Any], Any, Callable[[Any], Any]]] = deque(maxlen=WAITING)

    def receive(self, topic: Topic[Any], message: Any, *, decode: Callable[[Any], Any]) -> None:
        """Put a payload away."""
        self._waiting.append((topic, message, decode))

    def look(self) -> None:
        """Take in what has come."""
        while self._waiting:
            topic, payload, decode = self._waiting.popleft()
            try:
                self.take(topic, decode(payload))
            except CompanionError:
                continue  # a stranger's payload

    def take(self, topic: Topic[Any], message: Any) -> None:
        """One message."""
        if topic is topics.VEHICLE:
            self.vehicle = message
            self.flew = self.flew or self.airborne
        elif topic is topics.MISSION:
            self.mission = message
        elif topic is topics.SAFETY:
            self.safety = message
        elif topic is topics.TRUTH:
            self.truth = message
            self.contact = self.contact or message.contact
        for listener in self._listeners:
            listener.heard(topic, message)

    @property
    def airborne(self) -> bool:
        """As the autopilot says."""
        return self.vehicle is not None and self.vehicle.armed and not self.vehicle.landed

    @property
    def over(self) -> bool:
        """The mission has ended and the motors are off."""
        ended = self.mission is not None and self.mission.state in ("done", "failed")
        return ended and (self.vehicle is None or not self.vehicle.armed)

    def ending(self, *, lost: str = "") -> Ending:
        """What came out of it; `lost` says why the stack itself could not go on."""
        if self.contact:
            return Ending(False, f"touched {self.contact}", self.contact)
        if lost:
            return Ending(False, lost, "")
        if self.mission is None:
            return Ending(False, "the mission never started", "")
        if self.mission.state == "done":
            return Ending(True, "", "")
        if self.mission.state == "failed":
            return Ending(False, self.mission.reason, "")
        return Ending(False, f"stopped in step {self.mission.step_id}", "")
