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
from companion.runtime.bus.graph import Graph, Publisher
from companion.runtime.viewer import ViewTopic, announced, sensor_frames, views_of
from companion.runtime.wire import wire_type
from companion.runtime.wire.keys import Qos
from companion.runtime.wire.parts import time_of

SHOWN = Qos(depth=10)  # reliable, as RViz' displays ask by default
STATIC = Qos(transient_local=True, depth=1)


class SceneOutlet:
    """Views of the topics of one process."""

    def __init__(self, graph: Graph, published: Sequence[Topic[Any]], *, name: str, vehicle: str) -> None:
        self._vehicle = vehicle
        self._node = graph.node(name, namespace=f"/{vehicle}")
        every = dict.fromkeys(where for topic in published for where in announced(topic))
        self._publishers = {where: self._declare(where) for where in every}
        self._of = {topic.name: [self._publishers[where] for where in announced(topic)] for topic in published}

    def show_sensors(self, rig: Rig, now_ns: int) -> None:
        """Say once and for late joiners where the sensors sit."""
        view = sensor_frames(rig)
        kind = wire_type(view.where.type)
        publisher = self._node.publisher(view.where.full_name(self._vehicle), kind, STATIC, URGENCY["latched"])
        publisher.put(kind.encode(view.value), now_ns)

    def publish(self, topic: Topic[Any], message: Any, now_ns: int) -> None:
        """Show a message to those who look."""
        if not any(publisher.wanted for publisher in self._of.get(topic.name, ())):
            return
        for view in views_of(topic, message):
            publisher = self._publishers[view.where]
            if publisher.wanted:
                publisher.put(wire_type(view.where.type).encode(view.value), now_ns)

    def _declare(self, where: ViewTopic) -> Publisher:
        return self._node.publisher(where.full_name(self._vehicle), wire_type(where.type), SHOWN, URGENCY["bulk"])


class ClockOutlet:
    """`/clock` of a simulator, at the rate of its truth."""

    def __init__(self, graph: Graph, *, vehicle: str) -> None:
        self._kind = wire_type("rosgraph_msgs/msg/Clock")
        node = graph.node("simulated_clock", namespace=f"/{vehicle}")
        self._publisher = node.publisher("/clock", self._kind, Qos(reliable=False, depth=1), URGENCY["control"])

    def publish(self, topic: Topic[Any], message: Any, now_ns: int) -> None:
        """Tell the time, if anyone wants it from here."""
        if topic is topics.TRUTH and self._publisher.wanted:
            self._publisher.put(self._kind.encode({"clock": time_of(message.stamp_ns)}), now_ns)
