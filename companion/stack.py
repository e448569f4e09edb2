"""The flight stack: builds the nodes in the order of the data flow. Here the stages meet."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from companion.autopilot.node import AutopilotNode
from companion.config import Config
from companion.core.node import Node
from companion.estimation.node import GraphNode, LioNode, LoopNode, ObstacleTracksNode, PropagatorNode
from companion.estimation.warm_up import warm_up
from companion.mapping.landmark_node import LandmarkNode
from companion.mapping.node import MappingNode
from companion.mapping.shelf import Shelf
from companion.mission.model import Mission
from companion.mission.node import MissionNode
from companion.planning.node import PlanningNode
from companion.safety.node import SafetyNode
from companion.sensors.node import SensorsNode
from companion.tracking.node import TrackingNode

NODES = (
    SensorsNode, LioNode, PropagatorNode, GraphNode, LoopNode, MappingNode, ObstacleTracksNode,
    LandmarkNode, PlanningNode, TrackingNode, MissionNode, SafetyNode, AutopilotNode,
)  # fmt: skip

GROUPS: dict[str, tuple[type[Node], ...]] = {
    # One process each when the stack runs live: what control needs at once runs where control runs.
    "perception": (SensorsNode, LioNode),
    "graph": (GraphNode, LoopNode),
    # The local map is too large to leave its process.
    "world": (MappingNode, ObstacleTracksNode, LandmarkNode, PlanningNode),
    "control": (PropagatorNode, TrackingNode, MissionNode, SafetyNode, AutopilotNode),
}


def build(
    config: Config,
    mission: Mission,
    *,
    seed: int,
    only: Sequence[type[Node]] = NODES,
    signing_key: bytes | None = None,
    shelf: Shelf | None = None,
) -> list[Node]:
    """The nodes of the stack (or some of them), ready to be run by `companion.runtime`.

    Without a back end in `config.estimation` there is no GraphNode, and none follows obstacles if that
    is off. `shelf` takes what of the map is far away; None: that stays in memory.
    """
    makers: dict[type[Node], Callable[[], Node]] = {
        SensorsNode: lambda: SensorsNode(config.sensors),
        LioNode: lambda: LioNode(config.estimation, config.rig),
        PropagatorNode: lambda: PropagatorNode(config.estimation),
        GraphNode: lambda: GraphNode(config.estimation, config.rig),
        LoopNode: lambda: LoopNode(config.estimation.loops),
        MappingNode: lambda: MappingNode(config.mapping, config.rig, hull_radius_m=config.hull_radius_m, shelf=shelf),
        ObstacleTracksNode: lambda: ObstacleTracksNode(config.estimation.obstacle_tracks),
        LandmarkNode: lambda: LandmarkNode(config.mapping.landmarks, config.rig),
        PlanningNode: lambda: PlanningNode(config.planning, hull_radius_m=config.hull_radius_m, seed=seed),
        TrackingNode: lambda: TrackingNode(config.tracking),
        MissionNode: lambda: MissionNode(mission, config.mission),
        SafetyNode: lambda: SafetyNode(config.safety, fence=mission.fence),
        AutopilotNode: lambda: AutopilotNode(config.autopilot, signing_key=signing_key),
    }
    chosen = {
        GraphNode: config.estimation.back_end == "graph",
        ObstacleTracksNode: config.estimation.obstacle_tracks.enabled,
    }
    return [makers[kind]() for kind in only if chosen.get(kind, True)]


def warm(config: Config, nodes: Sequence[Node]) -> None:
    """Compile the kernels that the nodes' constructors have not compiled yet."""
    if any(isinstance(node, LioNode | PropagatorNode) for node in nodes):
        warm_up(config.estimation, config.rig)
