"""Rows of `companion bench tracking`: every method on the same courses in the same weather.

The simulator is the caller's (`new_sim`): this package does not know it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Annotated, Literal, get_args

import msgspec

from companion.autopilot.node import AutopilotNode
from companion.config import Config
from companion.core.node import Node
from companion.estimation.node import GraphNode, LioNode, PropagatorNode
from companion.mission.model import Mission
from companion.runtime.bench.tracking_flight import Flown, fly_course
from companion.runtime.bench.tracking_pilot import Course, PilotNode, TrueOdometryNode
from companion.runtime.bench.tracking_score import Score, score
from companion.sensors.node import SensorsNode
from companion.stack import build
from companion.tracking.follow import Method
from companion.tracking.node import TrackingNode

Estimate = Literal["own", "true"]
METHODS: tuple[Method, ...] = get_args(Method)
ESTIMATES: tuple[Estimate, ...] = get_args(Estimate)
WORST_M = 0.25
_ESTIMATORS: tuple[type[Node], ...] = (SensorsNode, LioNode, PropagatorNode, GraphNode)


class TrackingRow(msgspec.Struct, frozen=True, kw_only=True):
    """One flight; the targets are those of the method that flies."""

    course: str
    method: Method
    estimate: Estimate
    limit_m_s: float
    score: Score
    target_rmse_m: Annotated[float, msgspec.Meta(gt=0)]
    target_worst_m: float = WORST_M
    met: bool


def target_rmse_m(limit_m_s: float) -> float:
    """0.06 m up to 4 m/s, 0.10 m at 8 m/s, a straight line between."""
    return round(0.06 + 0.01 * min(max(limit_m_s - 4.0, 0.0), 4.0), 4)


def bench_tracking(
    courses: Sequence[Course],
    methods: Sequence[Method],
    config: Config,
    *,
    estimate: Estimate,
    new_sim: Callable[[], Node],
    mission: Mission,
) -> Iterator[TrackingRow]:
    """One row per course and method."""
    for course in courses:
        for method in methods:
            flown = fly(course, with_method(config, method), estimate=estimate, sim=new_sim(), mission=mission)
            yield row_of(flown, method, estimate)


def fly(course: Course, config: Config, *, estimate: Estimate, sim: Node, mission: Mission) -> Flown:
    """Fly a course with tracker, autopilot link, and own estimators or the truth."""
    own = estimate == "own"
    kinds = (*_ESTIMATORS, TrackingNode, AutopilotNode) if own else (TrackingNode, AutopilotNode)
    nodes = [*([] if own else [TrueOdometryNode()]), *build(config, mission, seed=0, only=kinds)]
    delays = {n: {k: round(v * 1e6) for k, v in d.items()} for n, d in config.lockstep.delay_ms.items()}
    return fly_course([sim, *nodes], PilotNode(course, turns=own), delays_ns=delays)


def with_method(config: Config, method: Method) -> Config:
    """The same configuration with another tracking law."""
    replace = msgspec.structs.replace
    follow = replace(config.tracking.follow, method=method)
    return replace(config, tracking=replace(config.tracking, follow=follow))


def row_of(flown: Flown, method: Method, estimate: Estimate) -> TrackingRow:
    """The score of a flight beside its targets."""
    figures, limit = score(flown), round(float(flown.course.limit_m_s), 3)
    good = figures.ended and not figures.contact
    return TrackingRow(
        course=flown.course.name,
        method=method,
        estimate=estimate,
        limit_m_s=limit,
        score=figures,
        target_rmse_m=target_rmse_m(limit),
        met=good and figures.rmse_m <= target_rmse_m(limit) and figures.worst_m <= WORST_M,
    )
