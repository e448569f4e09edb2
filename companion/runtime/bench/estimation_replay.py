"""Replay a recording into the estimators, and keep what they said.

run = feed(heard(folder), EstimationConfig(), Rig(), spoil=shorter(12.0))
run.states[-1].p_odom, run.cpu_ms_per_scan("LioNode")
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from time import thread_time
from typing import Any

from companion.core import topics
from companion.core.messages import GroundTruth, LioState, Odometry, SmoothedState, Why, freeze
from companion.core.node import Node, Topic
from companion.core.rig import Rig
from companion.estimation.config import EstimationConfig
from companion.estimation.node import GraphNode, LioNode, PropagatorNode
from companion.runtime.bench.estimation_joint import JOINT_STATE, JointWindowNode
from companion.runtime.bench.estimation_peers import Peer
from companion.runtime.lockstep import name

Spoil = Callable[[Topic[Any], Any], Any]
"""Takes a sensor's message and returns what becomes of it; None: it is lost."""


@dataclass(slots=True)
class Run:
    """What was said, and what it cost."""

    truth: list[GroundTruth] = field(default_factory=list)
    states: list[LioState] = field(default_factory=list)
    odometry: list[Odometry] = field(default_factory=list)
    smoothed: list[SmoothedState] = field(default_factory=list)
    joint: list[LioState] = field(default_factory=list)
    why: list[Why] = field(default_factory=list)
    scans: int = 0
    cpu_s: dict[str, float] = field(default_factory=dict)

    def forget_from(self, stamp_ns: int) -> None:
        """The clock went back: what was before has the same stamps as what comes."""
        lists: tuple[list[Any], ...] = (self.truth, self.states, self.odometry, self.smoothed, self.joint)
        for kept in lists:
            del kept[next((k for k, m in enumerate(kept) if m.stamp_ns >= stamp_ns), len(kept)) :]

    def cpu_ms_per_scan(self, *nodes: str) -> float:
        """CPU time of these nodes, per sweep; with none given, of all."""
        return 1e3 * sum(s for n, s in self.cpu_s.items() if not nodes or n in nodes) / max(self.scans, 1)


def feed(
    messages: Iterable[tuple[int, Topic[Any], Any]],
    config: EstimationConfig,
    rig: Rig,
    *,
    spoil: Spoil | None = None,
    with_graph: bool = True,
    with_joint: bool = False,
    others: Sequence[Peer] = (),
    until_s: float = float("inf"),
    others_until_s: float = float("inf"),
) -> Run:
    """Feed messages (arrival time in ns, topic, message) to fresh nodes, in their order; compute takes no time here.

    `others` get each sweep right after the nodes, so that all run under the same conditions, up to `others_until_s`.
    """
    run = Run()
    nodes: list[Node] = [LioNode(config, rig), PropagatorNode(config)]
    nodes += [GraphNode(config, rig)] if with_graph else []
    nodes += [JointWindowNode(config, rig)] if with_joint else []
    for time_ns, topic, heard_message in messages:
        if time_ns > until_s * 1e9:
            break
        message = spoil(topic, heard_message) if spoil else heard_message
        if message is not None:
            _deliver(run, nodes, topic, message)
            if topic is topics.LIDAR:
                run.scans += 1
                for other in others if time_ns <= others_until_s * 1e9 else ():
                    other.register(message)
    return run


def _deliver(run: Run, nodes: list[Node], topic: Topic[Any], message: Any) -> None:
    """To all who want it, and what they say of it to those behind them."""
    _keep(run, topic, message)
    for node in nodes:
        if topic.name not in node.handlers:
            continue
        started = thread_time()
        outputs = list(node.handle(topic, message))
        run.cpu_s[name(node)] = run.cpu_s.get(name(node), 0.0) + thread_time() - started
        for output in outputs:
            _deliver(run, nodes, output.topic, freeze(output.message))


def _keep(run: Run, topic: Topic[Any], message: Any) -> None:
    lists: dict[str, list[Any]] = {
        topics.TRUTH.name: run.truth,
        topics.LIO_STATE.name: run.states,
        topics.ODOMETRY.name: run.odometry,
        topics.SMOOTHED.name: run.smoothed,
        JOINT_STATE.name: run.joint,
        topics.WHY.name: run.why,
    }
    if topic is topics.TRUTH and run.truth and message.stamp_ns <= run.truth[-1].stamp_ns:
        run.forget_from(message.stamp_ns)
    if topic.name in lists:
        lists[topic.name].append(message)
