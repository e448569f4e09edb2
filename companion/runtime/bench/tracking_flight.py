"""One measured flight along a course, in lockstep, and what it came to.

flown = fly_course(nodes, PilotNode(course, turns=True), delays_ns=delays)
print(score(flown).rmse_m)
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import msgspec
import numpy as np

from companion.core import topics
from companion.core.correction import Correction
from companion.core.errors import CompanionError
from companion.core.geometry import quaternion_from_yaw, rotation_from_quaternion, yaw_of
from companion.core.messages import Array, GroundTruth, Odometry, Setpoint
from companion.core.node import Node, Topic
from companion.runtime.bench.tracking_pilot import Course, PilotNode
from companion.runtime.lockstep import Lockstep

_STEP_NS = 100_000_000
_PATIENCE_S = 60.0  # for the path to begin


class Flown(msgspec.Struct, frozen=True, kw_only=True, eq=False):
    """What was heard since the path began; times in s from then."""

    course: Course
    time_s: Array  # (N,), of the truth
    p_true: Array  # (N, 3), in map as it was when the estimate began
    v_true: Array  # (N, 3)
    setpoint_s: Array  # (M,)
    setpoint_p: Array  # (M, 3)
    setpoint_v: Array  # (M, 3)
    setpoint_a: Array  # (M, 3)
    p_map: Array  # (N, 3), the estimate at the truth's times
    clearance_m: float  # hull to trunks and branches, the smallest
    contact: str
    ended: bool  # came to rest at the end of the path


class Listener:
    """A tap that keeps what the score needs."""

    def __init__(self) -> None:
        self.truth: list[GroundTruth] = []
        self.setpoints: list[Setpoint] = []
        self.odometry: list[Odometry] = []
        self.p_map: list[Array] = []  # where odometry was in map, as known then
        self._correction = Correction.newest(None)
        self._kept: dict[str, list[Any]] = {
            topics.TRUTH.name: self.truth,
            topics.SETPOINT.name: self.setpoints,
            topics.ODOMETRY.name: self.odometry,
        }

    def published(self, now_ns: int, source: str, topic: Topic[Any], message: Any) -> int:
        """Keep it."""
        if topic is topics.SMOOTHED:
            self._correction = Correction.newest(message)
        elif topic is topics.ODOMETRY:
            self.p_map.append(self._correction.to_map(message.p_odom))
        if topic.name in self._kept:
            self._kept[topic.name].append(message)
        return 0

    def fed(self, now_ns: int, node: str, event: str, number: int) -> None:
        """Deliveries do not matter."""


def fly_course(nodes: Sequence[Node], pilot: PilotNode, *, delays_ns: Mapping[str, Mapping[str, int]]) -> Flown:
    """Fly `pilot.course` with the nodes, to its end or a contact; raises CompanionError if it never begins."""
    heard = Listener()
    lockstep = Lockstep([*nodes, pilot], delays_ns=delays_ns, tap=heard)
    while not pilot.done:
        lockstep.run_until(lockstep.now_ns + _STEP_NS)
        if heard.truth and heard.truth[-1].contact:
            break
        if pilot.begun_ns is None and lockstep.now_ns > _PATIENCE_S * 1e9:
            raise CompanionError(f"the vehicle did not take off within {_PATIENCE_S:g} s")
    lockstep.settle()
    return _flown(pilot, heard)


def _flown(pilot: PilotNode, heard: Listener) -> Flown:
    begun_ns = pilot.begun_ns or 0
    truth = [t for t in heard.truth if t.stamp_ns >= begun_ns]
    setpoints = [s for s in heard.setpoints if s.stamp_ns >= begun_ns]
    turn, shift = _into_map(heard)
    p_true = _rows([t.p_world for t in truth]) @ turn.T + shift
    end = pilot.course.points[-1]
    return Flown(
        course=pilot.course,
        time_s=np.array([(t.stamp_ns - begun_ns) * 1e-9 for t in truth]),
        p_true=p_true,
        v_true=_rows([t.v_world for t in truth]) @ turn.T,
        setpoint_s=np.array([(s.stamp_ns - begun_ns) * 1e-9 for s in setpoints]),
        setpoint_p=_rows([s.p_odom for s in setpoints]),
        setpoint_v=_rows([s.v_odom for s in setpoints]),
        setpoint_a=_rows([s.a_odom for s in setpoints]),
        p_map=_at([o.stamp_ns for o in heard.odometry], _rows(heard.p_map), truth),
        clearance_m=min((t.clearance_m for t in truth), default=float("nan")),
        contact=heard.truth[-1].contact if heard.truth else "",
        ended=pilot.done and len(p_true) > 0 and float(np.linalg.norm(p_true[-1] - end)) < 1.0,
    )


def _into_map(heard: Listener) -> tuple[Array, Array]:
    """Turn (3, 3) and shift (3,) of the world into map, by the first estimate: drift after it counts as error."""
    first = heard.odometry[0]
    truth = min(heard.truth, key=lambda t: abs(t.stamp_ns - first.stamp_ns))
    turn = rotation_from_quaternion(quaternion_from_yaw(yaw_of(first.q_odom_body) - yaw_of(truth.q_world_body)))
    return turn, first.p_odom - turn @ truth.p_world


def _at(stamps_ns: list[int], rows: Array, truth: list[GroundTruth]) -> Array:
    """Rows (K, 3) interpolated at the truth's times, (N, 3)."""
    times = [t.stamp_ns for t in truth]
    return np.column_stack([np.interp(times, stamps_ns, rows[:, k]) for k in range(3)])


def _rows(rows: list[Array]) -> Array:
    return np.array(rows).reshape(-1, 3)
