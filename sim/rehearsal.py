"""A short flight nobody sees, so that no kernel compiles while simulated time must keep pace with a clock."""

from __future__ import annotations

import math

import msgspec
import numpy as np

from sim.autopilot.modes import Mode
from sim.autopilot.readings import ExternalPose
from sim.config import SimConfig
from sim.node import TICK_NS, SimNode
from sim.sensors.render import NoRenderer
from sim.world import World

_REST_S, _FLIGHT_S = 1.5, 4.0


def rehearse(config: SimConfig, world: World) -> None:
    """Rest, arm, take off and hold by GPS, then hear an external pose: every kernel of vehicle and autopilot runs."""
    node = SimNode(msgspec.structs.replace(config, open_sky=True), world, NoRenderer(), seed=0)
    own = node.autopilot
    _run(node, 0.0, _REST_S)
    own.commander.set_mode(own.commander.now_ns, Mode.TAKEOFF)
    own.commander.arm(own.commander.now_ns)
    _run(node, _REST_S, _REST_S + _FLIGHT_S)
    own.estimator.external_pose(_pose(own.commander.now_ns))


def _run(node: SimNode, begin_s: float, end_s: float) -> None:
    for tick in range(round(begin_s * 1e9 / TICK_NS), round(end_s * 1e9 / TICK_NS)):
        for _ in node.tick("step", tick * TICK_NS):
            pass


def _pose(stamp_ns: int) -> ExternalPose:
    return ExternalPose(
        stamp_ns=stamp_ns,
        p=np.zeros(3),
        v=np.zeros(3),
        v_in_body=True,
        yaw=0.0,
        variance=np.full(7, math.nan),
        aligned_with_north=True,
        reset_counter=0,
        quality=100,
    )
