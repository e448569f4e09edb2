"""What every phase of a mission needs, and the way down: settle over a place to land, land, be done."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Literal

import numpy as np

from companion.core.correction import Correction
from companion.core.messages import MissionStatus, Odometry, PlanStatus, VehicleStatus, Why
from companion.core.node import Output
from companion.core.topics import GOAL, MISSION, VEHICLE_COMMAND, WHY
from companion.mission.commands import Kind, Requests
from companion.mission.config import MissionConfig
from companion.mission.estimate import estimate
from companion.mission.inputs import Inputs
from companion.mission.legs import Run, stop_goal
from companion.mission.schema import Mission, set_or

Outputs = Iterator[Output]
State = Literal["waiting", "running", "failing", "done", "failed"]


class Phases:
    """State, the phases after the last step, and what they share with those before; `Executor` adds the others."""

    def __init__(self, mission: Mission, config: MissionConfig) -> None:
        self._mission, self._config = mission, config
        self._requests = Requests(
            retry_ns=round(config.command_retry_s * 1e9),
            answer_ns=round(config.command_answer_s * 1e9),
            attempts=config.command_attempts,
        )
        self._timeouts_s = [
            set_or(s.timeout_s, config.timeout_factor * row.time_s + config.timeout_extra_s)
            for s, row in zip(mission.steps, estimate(mission), strict=True)
        ]
        self._phase: Callable[[int], Outputs] = self._over
        self._state: State = "waiting"
        self._reason = ""
        self._failure = ""
        self._index = 0
        self._since_ns: int | None = None  # of the phase
        self._armed_ns = 0
        self._retries = 0
        self._goal_id = 0
        self._home = np.zeros(3)
        self._offboard_seen = self._land_seen = False
        self._run: Run | None = None
        self._in = Inputs()

    @property
    def requests(self) -> Requests:
        """Commands under way; feed it COMMAND_RESULT."""
        return self._requests

    def status(self, now_ns: int) -> MissionStatus:
        """Where the mission stands."""
        return MissionStatus(
            stamp_ns=now_ns,
            step_id=self._mission.id_of(self._index),
            step_index=self._index,
            step_count=len(self._mission.steps),
            state=self._state,
            reason=self._failure or self._reason,
        )

    def _descend(self, now_ns: int) -> Outputs:
        """Land here, or near here where the planner knows the column below to be free."""
        self._enter(self._settle, now_ns)
        yield self._stop_goal(now_ns, "land")

    def _settle(self, now_ns: int) -> Outputs:
        """Brake before landing, over a place that the planner has found; bounded if it finds none."""
        speed = float(np.linalg.norm(self._odometry.v_odom))
        stopped = speed < self._config.settle_speed_m_s and self._elapsed_s(now_ns) > 0.5
        plan = self._in.plan if self._in.plan is not None and self._in.plan.goal_id == self._goal_id else None
        state = plan.state if plan is not None else "idle"
        on_the_way = state == "flying" and self._elapsed_s(now_ns) <= self._config.place_timeout_s
        late = self._elapsed_s(now_ns) > self._config.settle_timeout_s
        if (stopped and state in ("reached", "blocked")) or (late and not on_the_way):
            yield self._why(now_ns, "land", f"at {speed:.2f} m/s; {_of_place(state, plan)}")
            self._enter(self._landing, now_ns)

    def _landing(self, now_ns: int) -> Outputs:
        vehicle = self._vehicle
        if vehicle.landed and not vehicle.armed:
            yield from self._finish(now_ns, self._failure)
        elif vehicle.landed and self._elapsed_s(now_ns) > self._config.settle_timeout_s:
            yield from self._ask("disarm", now_ns)
        elif vehicle.mode != "LAND":
            yield from self._ask("land", now_ns)
            if self._requests.exhausted(now_ns):
                why = self._requests.refusal or "no answer"
                yield from self._finish(now_ns, f"the autopilot refuses to land: {why}")
        if self._phase == self._landing and self._elapsed_s(now_ns) > self._config.land_timeout_s:
            yield from self._finish(now_ns, f"not down after {self._config.land_timeout_s:g} s")

    def _finish(self, now_ns: int, failure: str) -> Outputs:
        self._failure = failure
        self._state = "failed" if failure else "done"
        yield self._why(now_ns, f"mission {self._state}", failure or "landed and disarmed")
        self._enter(self._over, now_ns)
        yield MISSION(self.status(now_ns))

    def _over(self, now_ns: int) -> Outputs:
        return iter(())

    # --- helpers ---------------------------------------------------------------------

    @property
    def _correction(self) -> Correction:
        return Correction.newest(self._in.smoothed)

    @property
    def _odometry(self) -> Odometry:
        assert self._in.odometry is not None  # the start waited for it
        return self._in.odometry

    @property
    def _vehicle(self) -> VehicleStatus:
        assert self._in.vehicle is not None  # the start waited for it
        return self._in.vehicle

    def _enter(self, phase: Callable[[int], Outputs], now_ns: int) -> None:
        self._phase, self._since_ns = phase, now_ns
        self._requests.reset()

    def _elapsed_s(self, now_ns: int) -> float:
        assert self._since_ns is not None
        return (now_ns - self._since_ns) * 1e-9

    def _ask(self, kind: Kind, now_ns: int) -> Outputs:
        command = self._requests.ask(kind, now_ns)
        if command is not None:
            yield VEHICLE_COMMAND(command)

    def _stop_goal(self, now_ns: int, kind: Literal["hold", "land"]) -> Output:
        self._goal_id += 1
        limits = self._mission.limits_of(self._mission.steps[self._index])
        return GOAL(stop_goal(now_ns, self._goal_id, kind, self._odometry.p_odom, limits))

    def _why(self, now_ns: int, what: str, because: str) -> Output:
        return WHY(Why(stamp_ns=now_ns, node="mission", what=what, because=because))


def _of_place(state: str, plan: PlanStatus | None) -> str:
    """What is known of the place below, in words."""
    if state == "reached":
        return "the column below is known free"
    if state == "blocked" and plan is not None:
        return f"although {plan.reason}"
    return "although nobody said that the column below is free"
