"""Compile every kernel before the flight: a first plan must not wait for the compiler."""

from __future__ import annotations

import numpy as np

from companion.core.messages import Limits, LocalMap, freeze
from companion.planning.config import PlanningConfig
from companion.planning.flown import with_speeds
from companion.planning.registry import make_planner
from companion.planning.smooth import smooth
from companion.planning.space import FieldSpace, fill_ground
from companion.planning.wave import Wave

_ENCLOSED = np.array([3.5, 3.1, 1.1])  # a free cell between blocked ones


def warm_up(config: PlanningConfig, *, hull_radius_m: float) -> None:
    """One plan around a wall in a world of a few cells."""
    local_map = _wall()
    ground = fill_ground(local_map)
    space = FieldSpace(local_map, radius_m=0.2, ground_z=ground, agl_m=(0.0, 9.0))
    start, goal = np.array([1.0, 1.0, 1.0]), np.array([3.0, 1.0, 1.0])
    seed = np.random.default_rng(0)
    planner = make_planner(config.route.planner, config)
    planner.plan(start, goal, space, rng=seed, iterations=2000)  # RRT-Connect first, at last the lattice
    plan = planner.plan(start, goal, space, rng=seed, iterations=500, known_path=goal[None])
    planner.plan(start, _ENCLOSED, space, rng=seed, iterations=500)  # a proof, of planners that give one
    Wave(space.steps, space.to_cells(np.stack([start, goal])), block=1).path()
    path = smooth(plan.path, space, config.smooth)
    limits = Limits(
        speed=1.0,
        climb=1.0,
        accel=1.0,
        jerk=20.0,
        yaw_rate=1.0,
        clearance=0.1,
        unknown="stop_before",
        agl_min=0.0,
        agl_max=9.0,
    )
    radius = hull_radius_m
    with_speeds(
        path,
        space,
        limits,
        config.speed,
        hull_radius_m=radius,
        known_radius_m=radius,
        start=(0.0, 0.0),
        reach_m=0.0,
    )


def _wall() -> LocalMap:
    state = np.ones((20, 20, 10), np.uint8)
    state[10, 2:8] = 2
    distance = np.full(state.shape, 2.0, np.float32)
    distance[9:12, 1:9] = 0.1
    distance[15:20, 13:18, 2:9] = 0.1
    distance[17, 15, 5] = 0.25
    ground = np.full((20, 20), np.nan, np.float32)
    ground[0, 0] = 0.0
    wall = LocalMap(
        stamp_ns=0,
        origin_odom=np.zeros(3),
        resolution_m=0.2,
        state=state,
        distance_m=distance,
        unknown_distance_m=distance,
        ground_z_odom=ground,
    )
    freeze(wall)  # read-only arrays are types of their own
    return wall
