"""Who is on the bus: every node and endpoint of the ROS 2 graph, ours and strangers'."""

from __future__ import annotations

from companion.runtime.bus.graph import Graph
from companion.runtime.wire.errors import WireError
from companion.runtime.wire.keys import Entity, node_token_query, parse_token

ANSWER_S = 1.0


class Directory:
    """Asks for liveliness tokens each time; what is no token of ROS 2 is passed over."""

    def __init__(self, graph: Graph) -> None:
        self._graph = graph

    def entities(self) -> list[Entity]:
        """Everything that is alive now, in the order of names."""
        replies = self._graph.session.liveliness().get(node_token_query(self._graph.domain), timeout=ANSWER_S)
        found = []
        for reply in replies:
            if reply.ok is not None:
                try:
                    found.append(parse_token(str(reply.ok.key_expr)))
                except WireError:
                    continue
        return sorted(found, key=lambda e: (e.namespace, e.node, e.kind, e.topic))

    def nodes(self) -> list[Entity]:
        """Every node once."""
        return [e for e in self.entities() if e.kind == "NN"]
