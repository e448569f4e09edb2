"""The stack's topics on the bus: what the nodes publish goes out, what they want comes in.

On the bus a topic is called `/<vehicle>/<topic>`; the vehicle's name is the ROS namespace.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any, Protocol

import zenoh

from companion.core import topics
from companion.core.node import Service, Topic
from companion.runtime.bus.gaps import Gaps
from companion.runtime.bus.graph import Arrival, Graph, Publisher, Urgency
from companion.runtime.pulse import Pulse
from companion.runtime.wire import codec_of
from companion.runtime.wire.keys import qos_of

LINK_ONLY = (topics.MAVLINK_RX, topics.MAVLINK_TX)  # nobody on the bus may speak for the vehicle, or to it
URGENCY: dict[Service, Urgency] = {
    "control": Urgency(zenoh.Priority.REAL_TIME, express=True),
    "state": Urgency(zenoh.Priority.INTERACTIVE_HIGH, express=True),
    "bulk": Urgency(zenoh.Priority.DATA_LOW),
    "latched": Urgency(zenoh.Priority.INTERACTIVE_HIGH),
    "history": Urgency(zenoh.Priority.DATA_LOW),
}


class Receiver(Protocol):
    """Takes messages that are still encoded."""

    def receive(self, topic: Topic[Any], message: Any, *, decode: Any) -> None:
        """One payload of a topic; `decode` makes the message."""


def bus_name(topic: Topic[Any], vehicle: str) -> str:
    """Full name of a topic on the bus."""
    return f"/{vehicle}/{topic.name}"


class BusOutlet:
    """Publishes the topics of some nodes, without those that are for a link alone.

    A topic of several nodes is declared by the first.
    """

    def __init__(
        self,
        graph: Graph,
        published: Mapping[str, Sequence[Topic[Any]]],
        *,
        vehicle: str,
        urgency: Mapping[Service, Urgency] = URGENCY,
    ) -> None:
        self._publishers: dict[str, Publisher] = {}
        self.sent: Counter[str] = Counter()
        self.sent_bytes = 0
        for node, topics_of_node in published.items():
            entity = graph.node(node, namespace=f"/{vehicle}")
            for topic in topics_of_node:
                if topic.name not in self._publishers and topic not in LINK_ONLY:
                    self._publishers[topic.name] = entity.publisher(
                        bus_name(topic, vehicle), codec_of(topic).type, qos_of(topic), urgency[topic.service]
                    )

    def publish(self, topic: Topic[Any], message: Any, now_ns: int) -> None:
        """Encode and send, if anyone listens."""
        publisher = self._publishers.get(topic.name)
        if publisher is None or not publisher.wanted:
            return
        payload = codec_of(topic).encode(message)
        publisher.put(payload, now_ns)
        self.sent[topic.name] += 1
        self.sent_bytes += len(payload)

    def figures(self) -> dict[str, float]:
        """How much was sent."""
        return {"bus_sent": sum(self.sent.values()), "bus_sent_mb": self.sent_bytes / 1e6}


class Hearing:
    """Subscriptions of a group; counts what was lost on the way, by gaps in the senders' numbers."""

    def __init__(
        self, graph: Graph, wanted: Sequence[Topic[Any]], receiver: Receiver, *, listener: str, vehicle: str
    ) -> None:
        self.heard: Counter[str] = Counter()
        self._gaps = {topic.name: Gaps() for topic in wanted}
        self._pulse = Pulse(topic for topic in wanted if topic not in LINK_ONLY)
        self._receiver = receiver
        entity = graph.node(listener, namespace=f"/{vehicle}")
        for topic in wanted:
            if topic not in LINK_ONLY:
                self._subscribe(entity, topic, vehicle)

    @property
    def lost(self) -> dict[str, int]:
        """Samples lost per topic, where there are any."""
        return {topic: gaps.lost for topic, gaps in self._gaps.items() if gaps.lost}

    def figures(self) -> dict[str, float]:
        """Samples heard and lost."""
        totals: dict[str, float] = {"bus_heard": sum(self.heard.values()), "bus_lost": sum(self.lost.values())}
        return totals | {f"lost {topic}": count for topic, count in self.lost.items()} | self._pulse.figures("heard")

    def _subscribe(self, entity: Any, topic: Topic[Any], vehicle: str) -> None:
        decode = codec_of(topic).decode

        def take(arrival: Arrival) -> None:
            self.heard[topic.name] += 1
            self._gaps[topic.name].note(arrival.attachment)
            self._pulse.publish(topic, arrival.payload, 0)
            self._receiver.receive(topic, arrival.payload, decode=decode)

        entity.subscribe(bus_name(topic, vehicle), codec_of(topic).type, qos_of(topic), take)
