"""The three nodes of estimation: front end, propagator to the present, and graph."""

from companion.estimation.graph_node import GraphNode
from companion.estimation.lio_node import LioNode
from companion.estimation.propagator_node import PropagatorNode

__all__ = ["GraphNode", "LioNode", "PropagatorNode"]
