"""The mission node: keeps the newest inputs, steps the executor, says where the mission stands."""

from __future__ import annotations

from companion.core import topics
from companion.core.messages import (
    CommandResult,
    MissionStatus,
    Odometry,
    PlanStatus,
    SafetyStatus,
    SmoothedState,
    VehicleStatus,
)
from companion.core.node import Node, Outputs, every, on
from companion.mission.config import MissionConfig
from companion.mission.executor import Executor
from companion.mission.inputs import Inputs
from companion.mission.schema import Mission

STATUS_PERIOD_NS = 500_000_000


class MissionNode(Node):
    """Drives the goals and the few commands of a flight."""

    publishes = (topics.GOAL, topics.VEHICLE_COMMAND, topics.MISSION, topics.WHY)

    def __init__(self, mission: Mission, config: MissionConfig) -> None:
        self._executor, self._inputs = Executor(mission, config), Inputs()
        self._said: tuple[str, str, str] = ("", "", "")
        self._said_ns = -STATUS_PERIOD_NS

    @on(topics.ODOMETRY)
    def _odometry(self, message: Odometry) -> None:
        self._inputs.odometry = message

    @on(topics.SMOOTHED)
    def _smoothed(self, message: SmoothedState) -> None:
        self._inputs.smoothed = message

    @on(topics.VEHICLE)
    def _vehicle(self, message: VehicleStatus) -> None:
        self._inputs.vehicle = message

    @on(topics.PLAN)
    def _plan(self, message: PlanStatus) -> None:
        self._inputs.plan = message

    @on(topics.SAFETY)
    def _safety(self, message: SafetyStatus) -> None:
        self._inputs.safety = message

    @on(topics.COMMAND_RESULT)
    def _result(self, message: CommandResult) -> None:
        self._executor.requests.heard(message)

    @every(hz=10)
    def decide(self, now_ns: int) -> Outputs:
        """One decision, and the status when it changed or is due."""
        yield from self._executor.step(now_ns, self._inputs)
        status = self._executor.status(now_ns)
        if self._due(status):
            self._said, self._said_ns = _gist(status), now_ns
            yield topics.MISSION(status)

    def _due(self, status: MissionStatus) -> bool:
        return _gist(status) != self._said or status.stamp_ns - self._said_ns >= STATUS_PERIOD_NS


def _gist(status: MissionStatus) -> tuple[str, str, str]:
    return status.state, status.step_id, status.reason
