"""Standard ROS 2 topics beside our own while somebody looks: RViz, Foxglove and Rerun show a scene at once.

Costs nothing when nobody listens: a message is turned into views only for topics that are wanted.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from companion.core import topics
from companion.core.node import Topic
from companion.core.rig import Rig
from companion.runtime.bus.attach import URGENCY
from companion.runtime.bus.graph import Graph, GraphNode, Publisher
from companion.runtime.viewer import ANNOUNCED, View, ViewTopic, sensor_frames, views_of
from companion.runtime.wire import wire_type
from companion.runtime.wire.keys import Qos

SHOWN = Qos(depth=10)  # reliable, as RViz' displays ask by default
STATIC = Qos(transient_local=True, depth=1)


class SceneOutlet:
    """Views of the topics of one process."""

    def __init__(self, graph: Graph, published: Sequence[Topic[Any]], *, name: str, vehicle: str) -> None:
        self._vehicle = vehicle
        self._node = graph.node(name, namespace=f"/{vehicle}")
        views = {view.topic: view for topic in published for view in ANNOUNCED.get(topic.name, ())}
        self._publishers = {view.topic: self._declare(self._node, view) for view in views.values()}
        self._of = {t.name: [self._publishers[v.topic] for v in ANNOUNCED.get(t.name, ())] for t in published}

    def show_sensors(self, rig: Rig, now_ns: int) -> None:
        """Say once and for late joiners where the sensors sit."""
        view = sensor_frames(rig)
        kind = wire_type(view.type)
        publisher = self._node.publisher(self._full_name(view), kind, STATIC, URGENCY["latched"])
        publisher.put(kind.encode(view.value), now_ns)

    def publish(self, topic: Topic[Any], message: Any, now_ns: int) -> None:
        """Show a message to those who look."""
        if not any(publisher.wanted for publisher in self._of.get(topic.name, ())):
            return
        for view in views_of(topic, message):
            publisher = self._publishers[view.topic]
            if publisher.wanted:
                publisher.put(wire_type(view.type).encode(view.value), now_ns)

    def _declare(self, node: GraphNode, view: ViewTopic) -> Publisher:
        return node.publisher(self._full_name(view), wire_type(view.type), SHOWN, URGENCY["bulk"])

    def _full_name(self, view: View | ViewTopic) -> str:
        return f"/{view.topic}" if view.shared else f"/{self._vehicle}/{view.topic}"


class ClockOutlet:
    """`/clock` of a simulator, at the rate of its truth."""

    def __init__(self, graph: Graph, *, vehicle: str) -> None:
        self._kind = wire_type("rosgraph_msgs/msg/Clock")
        node = graph.node("simulated_clock", namespace=f"/{vehicle}")
        self._publisher = node.publisher("/clock", self._kind, Qos(reliable=False, depth=1), URGENCY["control"])

    def publish(self, topic: Topic[Any], message: Any, now_ns: int) -> None:
        """Tell the time, if anyone wants it from here."""
        if topic is topics.TRUTH and self._publisher.wanted:
            seconds, rest = divmod(message.stamp_ns, 1_000_000_000)
            self._publisher.put(self._kind.encode({"clock": {"sec": seconds, "nanosec": rest}}), now_ns)
