"""What the estimation stage can be told."""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec

from companion.estimation.camera import CameraConfig
from companion.estimation.graph import GraphConfig
from companion.estimation.health import HealthConfig
from companion.estimation.lio import LioConfig
from companion.estimation.loop_node import LoopNodeConfig
from companion.estimation.ordering import OrderConfig
from companion.estimation.tracks.node import ObstacleTracksConfig

Positive = Annotated[float, msgspec.Meta(gt=0)]


class PropagatorConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The odometry that control flies on."""

    rate_hz: Positive = 100.0
    drift_share: Annotated[float, msgspec.Meta(ge=0)] = 0.02  # of the way since the last scan, added to sigma
    blind_after_s: Positive = 0.45  # without a scan or an image: quality 0
    reset_from_m: Positive = 0.3  # a correction beyond it, after a gap, counts as a reset: the autopilot must know
    health: HealthConfig = HealthConfig()


class EstimationConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Front end, camera, order of arrival, propagator, graph and loops."""

    lio: LioConfig = LioConfig()
    camera: CameraConfig = CameraConfig()
    order: OrderConfig = OrderConfig()
    propagator: PropagatorConfig = PropagatorConfig()
    back_end: Literal["graph", "none"] = "graph"  # none: the filter alone, for small computers; map stays odom
    graph: GraphConfig = GraphConfig()
    loops: LoopNodeConfig = LoopNodeConfig()
    obstacle_tracks: ObstacleTracksConfig = ObstacleTracksConfig()
