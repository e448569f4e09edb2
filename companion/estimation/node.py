"""The nodes of estimation: front end, propagator to the present, graph, loops, and tracks of what moves."""

from companion.estimation.graph_node import GraphNode
from companion.estimation.lio_node import LioNode
from companion.estimation.loop_node import LoopNode
from companion.estimation.propagator_node import PropagatorNode
from companion.estimation.tracks.node import ObstacleTracksNode

__all__ = ["GraphNode", "LioNode", "LoopNode", "ObstacleTracksNode", "PropagatorNode"]
