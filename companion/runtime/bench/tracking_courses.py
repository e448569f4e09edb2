"""Courses to be tracked: a slalom in the open, and ways through a simulated forest as the planner makes them.

course = slalom(top_m_s=4.0)
course = forest_course(cones, top_m_s=8.0)      # cones (M, 9) as the simulator's worlds have them
"""

from __future__ import annotations

import math

import numpy as np
from scipy.ndimage import distance_transform_edt

from companion.core.errors import CompanionError
from companion.core.messages import Array, Limits, LocalMap, freeze
from companion.planning.polyline import resample
from companion.planning.registry import PlannerSettings, make_planner
from companion.planning.smooth import SmoothConfig, smooth
from companion.planning.space import FieldSpace
from companion.planning.speed_profile import SpeedConfig, speed_profile
from companion.runtime.bench.tracking_pilot import Course

HULL_M, CLEARANCE_M, ACCEL, JERK = 0.36, 0.6, 5.0, 40.0
HEIGHT_M = 3.0
_RESOLUTION_M, _FIELD_M = 0.2, 3.0


def slalom(*, top_m_s: float, gates: int = 4, pitch_m: float = 12.0, swing_m: float = 1.5) -> Course:
    """A sine of amplitude `swing_m` between straight ends, level, 60 m by default."""
    x = np.arange(0.0, (gates + 1) * pitch_m + 1e-9, 0.05)
    ramp = np.clip(np.minimum(x, x[-1] - x) / pitch_m, 0.0, 1.0)
    y = swing_m * np.sin(2 * math.pi * x / (2 * pitch_m)) * ramp**2 * (3 - 2 * ramp)
    path = np.column_stack([x, y, np.full(len(x), HEIGHT_M)])
    return paced("slalom", path, top_m_s=top_m_s)


def forest_course(
    cones: Array, *, top_m_s: float, length_m: float = 70.0, seed: int = 1, name: str = "forest"
) -> Course:
    """The planner's way, smoothed, from above the origin `length_m` to the east past trunks and branches."""
    space = space_of(cones, (-4.0, -15.0), (length_m + 4.0, 15.0))
    start, goal = np.array([0.0, 0.0, HEIGHT_M]), np.array([length_m, 0.0, HEIGHT_M])
    planner = make_planner("rrt_star", PlannerSettings())
    plan = planner.plan(start, free_near(space, goal), space, rng=np.random.default_rng(seed), iterations=4000)
    if not plan.solved:
        raise CompanionError("no way through this forest: try another --seed")
    path = smooth(plan.path, space, SmoothConfig())
    return paced(name, path, top_m_s=top_m_s, space=space)


def paced(name: str, path: Array, *, top_m_s: float, space: FieldSpace | None = None) -> Course:
    """Speeds as the planner gives them for a goal with these limits."""
    config = SpeedConfig()
    points = resample(path, config.spacing_m)
    limits = Limits(
        speed=top_m_s, climb=3.0, accel=ACCEL, jerk=JERK, yaw_rate=1.5, clearance=CLEARANCE_M, unknown="optimistic",
        agl_min=0.5, agl_max=10.0,
    )  # fmt: skip
    clearance_m = np.full(len(points), 10.0) if space is None else space.distance(points) - HULL_M
    speeds = speed_profile(points, limits, config, clearance_m=clearance_m, start=(0.0, 0.0))
    return Course(name=name, points=points, speeds=speeds, limit_m_s=top_m_s, accel=ACCEL)


def space_of(cones: Array, low_xy: tuple[float, float], high_xy: tuple[float, float]) -> FieldSpace:
    """Cells between two corners that a cone touches; the height is kept within a metre."""
    low, high = np.array([*low_xy, 0.0]), np.array([*high_xy, 6.0])
    shape = np.round((high - low) / _RESOLUTION_M).astype(int)
    occupied = np.zeros(shape, bool)
    for cone in cones:
        if np.all(cone[:2] > low[:2] - 16.0) and np.all(cone[:2] < high[:2] + 16.0):
            _mark(occupied, low, cone)
    gap = (distance_transform_edt(~occupied) - 0.5) * _RESOLUTION_M
    distance = np.clip(gap, 0.0, _FIELD_M).astype(np.float32)
    local_map = LocalMap(
        stamp_ns=0,
        origin_odom=low,
        resolution_m=_RESOLUTION_M,
        state=np.where(occupied, 2, 1).astype(np.uint8),
        distance_m=distance,
        unknown_distance_m=distance,
        ground_z_odom=np.zeros(shape[:2], np.float32),
    )
    return FieldSpace(
        freeze(local_map), radius_m=HULL_M + CLEARANCE_M, unknown="optimistic",
        ground_z=local_map.ground_z_odom, agl_m=(HEIGHT_M - 1.0, HEIGHT_M + 1.0),
    )  # fmt: skip


def _mark(occupied: np.ndarray, low: Array, cone: Array) -> None:
    """Cells within the cone's radius (and half a cell) of points on its axis."""
    count = max(math.ceil(cone[6] / _RESOLUTION_M), 1)
    share = np.linspace(0.0, 1.0, count + 1)
    axis = cone[:3] + share[:, None] * cone[6] * cone[3:6]
    radius = cone[7] + share * (cone[8] - cone[7]) + 0.5 * _RESOLUTION_M
    reach = math.ceil(float(radius.max()) / _RESOLUTION_M)
    around = np.stack(np.meshgrid(*[np.arange(-reach, reach + 1)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    centre = np.floor((axis - low) / _RESOLUTION_M)
    cells = (centre[:, None] + around).astype(int)
    off = np.linalg.norm((cells + 0.5) * _RESOLUTION_M + low - axis[:, None], axis=-1)
    inside = (off <= radius[:, None]) & np.all((cells >= 0) & (cells < occupied.shape), axis=-1)
    occupied[tuple(cells[inside].T)] = True


def free_near(space: FieldSpace, goal: Array) -> Array:
    """The goal (3,), or the free place nearest to it."""
    if bool(space.free(goal[None])[0]):
        return goal
    places = space.free_cells_near(goal, within_m=4.0)
    if not len(places):
        raise CompanionError("no free place at the end of the course: try another --seed")
    return np.asarray(places[0])
