"""The flight stack: builds the nodes in the order of the data flow. Here the stages meet."""

from __future__ import annotations

from companion.autopilot.node import AutopilotNode
from companion.config import Config
from companion.core.node import Node
from companion.estimation.node import GraphNode, LioNode, PropagatorNode
from companion.mapping.node import MappingNode
from companion.mission.model import Mission
from companion.mission.node import MissionNode
from companion.planning.node import PlanningNode
from companion.safety.node import SafetyNode
from companion.sensors.node import SensorsNode
from companion.tracking.node import TrackingNode


def build(config: Config, mission: Mission, *, seed: int) -> list[Node]:
    """All nodes of the stack, ready to be run by `companion.runtime`."""
    return [
        SensorsNode(config.sensors),
        LioNode(config.estimation, config.rig),
        PropagatorNode(config.estimation),
        GraphNode(config.estimation, config.rig),
        MappingNode(config.mapping, config.rig, hull_radius_m=config.hull_radius_m),
        PlanningNode(config.planning, hull_radius_m=config.hull_radius_m, seed=seed),
        TrackingNode(config.tracking),
        MissionNode(mission, config.mission),
        SafetyNode(config.safety, fence=mission.fence),
        AutopilotNode(config.autopilot),
    ]
