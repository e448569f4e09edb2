"""Hull against trunks, branches, walls, walkers and ground: signed clearances at the physics rate.

The hull is a set of spheres; trunks and branches are solid cone frusta, the ground a height
field. Cones near the aircraft are kept in a list that is made anew from a grid only after it
has moved by `_SKIN_M`, and only a cone that could lower the running minimum is measured exactly.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from companion.core.errors import InputError
from companion.core.messages import Array
from sim.world.columns import Columns, items_near
from sim.world.reach import sort_cones
from sim.world.terrain import _height
from sim.world.walkers import NOBODY, Walkers, feet_of
from sim.world.walls import NO_WALLS, Walls, point_to_triangle

REACH_M = 4.0  # clearances are measured up to here; "nothing within reach" reads as this
_SKIN_M = 1.0
CONTACTS = ("", "trunk", "branch", "ground", "walker", "wall")


@dataclass(frozen=True, eq=False)
class Obstacles:
    """What the hull can touch, world frame."""

    cones: Array  # (M, 9): base xyz, unit axis xyz, length, radius at the base, radius at the tip
    kinds: NDArray[np.int8]  # (M,): 0 trunk, 1 branch
    heights: Array  # (nx, ny), ground at origin_xy + (i, j) * cell_m
    origin_xy: Array  # (2,)
    cell_m: float
    walkers: Walkers = NOBODY
    walls: Walls = NO_WALLS  # surfaces: a hull is either clear of them or touches them

    def __post_init__(self) -> None:
        if self.cones.ndim != 2 or self.cones.shape[1] != 9 or len(self.kinds) != len(self.cones):
            raise InputError(
                f"shapes {self.cones.shape} and {self.kinds.shape}",
                field="cones, kinds",
                valid="(M, 9), (M,)",
            )
        if not (np.all(np.isfinite(self.cones)) and np.all(np.isfinite(self.heights))):
            raise InputError("holds NaN or infinity", field="cones, heights", valid="finite values")


def flat_ground(z_m: float = 0.0, *, half_size_m: float = 200.0) -> Obstacles:
    """Level ground without obstacles."""
    return Obstacles(
        cones=np.zeros((0, 9)),
        kinds=np.zeros(0, np.int8),
        heights=np.full((2, 2), float(z_m)),
        origin_xy=np.array([-half_size_m, -half_size_m]),
        cell_m=2 * half_size_m,
    )


def frustum_distance(cone: Array, point: Array) -> float:
    """Signed distance of a point (3,) to a solid frustum (9,), m; negative inside."""
    return float(_frustum_distance(cone, point[0], point[1], point[2]))


class NearWalls:
    """Walls near the aircraft and the scratch space to find them, as `Near` for cones."""

    def __init__(self, walls: Walls) -> None:
        center: Array = np.full(3, np.nan)  # about which the list was made
        near = np.zeros(len(walls) + 1, np.int64)  # [0]: how many
        seen = np.zeros(len(walls) + 1, np.int64)  # [-1]: number of the search
        self.arguments: tuple[Any, ...] = walls.tables(), center, near, seen  # of the kernel


class Near:
    """Cones near the aircraft and the scratch space to find them."""

    def __init__(self, obstacles: Obstacles) -> None:
        count = len(obstacles.cones)
        self.cones: Array = np.ascontiguousarray(obstacles.cones, dtype=np.float64)
        self.kinds = np.ascontiguousarray(obstacles.kinds, dtype=np.int8)
        self.grid: Columns = sort_cones(self.cones)
        self.frame: Array = np.array([*self.grid.frame, np.nan, np.nan, np.nan])
        self.list: NDArray[np.int64] = np.zeros(count + 1, np.int64)  # [0]: how many
        self.seen: NDArray[np.int64] = np.zeros(count + 1, np.int64)  # [-1]: number of the search


def clearance(obstacles: Obstacles, spheres: Array, x: Array) -> tuple[float, str]:
    """Smallest signed distance of hull to cones, at most REACH_M, and the kind of a cone touched.

    `spheres` (N, 5) as from `hull_spheres`, x the state (17,).
    """
    near = Near(obstacles)
    best, kind = _cone_clearance(
        x,
        spheres,
        near.cones,
        near.kinds,
        near.frame,
        near.grid.start,
        near.grid.items,
        near.list,
        near.seen,
        REACH_M,
    )
    return float(best), CONTACTS[kind]


@njit(cache=True, nogil=True)
def _cone_clearance(x, spheres, cones, kinds, frame, start, items, near, seen, best):  # type: ignore[no-untyped-def]
    """Lowers `best` if a cone is nearer; also the code of CONTACTS of a cone that is touched."""
    reach = _hull_reach(spheres)
    dx, dy, dz = x[0] - frame[4], x[1] - frame[5], x[2] - frame[6]
    if not dx * dx + dy * dy + dz * dz < _SKIN_M * _SKIN_M:
        _gather(x, cones, frame, start, items, near, seen, reach + REACH_M + _SKIN_M)
    kind = 0
    for k in range(1, near[0] + 1):
        cone = cones[near[k]]
        bound = _axis_distance(cone, x[0], x[1], x[2]) - max(cone[7], cone[8]) - reach
        if bound >= best:
            continue
        for s in range(spheres.shape[0]):
            px, py, pz = _to_world(x, spheres[s])
            gap = _frustum_distance(cone, px, py, pz) - spheres[s, 3]
            if gap < best:
                best = gap
                if gap <= 0.0:
                    kind = 1 + kinds[near[k]]
    return best, kind


@njit(cache=True, nogil=True)
def _walker_clearance(x, spheres, walkers, time_s, best):  # type: ignore[no-untyped-def]
    """Lowers `best` if a walker is nearer at that time; also whether one is touched."""
    tracks, rows, traits = walkers
    reach = _hull_reach(spheres)
    touched = False
    cylinder = np.zeros(9)
    cylinder[5] = 1.0
    for k in range(rows.shape[0]):
        feet = feet_of(tracks, rows, traits, k, time_s)
        cylinder[0], cylinder[1], cylinder[2] = feet
        cylinder[6], cylinder[7], cylinder[8] = traits[k, 4], traits[k, 3], traits[k, 3]
        if _axis_distance(cylinder, x[0], x[1], x[2]) - traits[k, 3] - reach >= best:
            continue
        for s in range(spheres.shape[0]):
            px, py, pz = _to_world(x, spheres[s])
            gap = _frustum_distance(cylinder, px, py, pz) - spheres[s, 3]
            best = min(best, gap)
            touched = touched or gap <= 0.0
    return best, touched


@njit(cache=True, nogil=True)
def _wall_clearance(x, spheres, walls, best):  # type: ignore[no-untyped-def]
    """Lowers `best` if a wall is nearer; also whether one is touched.

    The nearest wall comes first in the list: mostly it is again, and then the others cost little.
    """
    (corners, balls, frame, start, items), center, near, seen = walls
    reach = _hull_reach(spheres)
    dx, dy, dz = x[0] - center[0], x[1] - center[1], x[2] - center[2]
    if not dx * dx + dy * dy + dz * dz < _SKIN_M * _SKIN_M:
        _gather_walls(x, (balls, frame, start, items), center, near, seen, reach + REACH_M + _SKIN_M)
    touched = False
    for k in range(1, near[0] + 1):
        t = near[k]
        bx, by, bz = balls[t, 0] - x[0], balls[t, 1] - x[1], balls[t, 2] - x[2]
        room = best + reach + balls[t, 3]
        if bx * bx + by * by + bz * bz >= room * room:
            continue
        for s in range(spheres.shape[0]):
            px, py, pz = _to_world(x, spheres[s])
            gap = point_to_triangle(corners[t], px, py, pz) - spheres[s, 3]
            if gap < best:
                best = gap
                near[1], near[k] = near[k], near[1]
                touched = touched or gap <= 0.0
    return best, touched


@njit(cache=True, nogil=True)
def _gather_walls(x, walls, center, near, seen, reach):  # type: ignore[no-untyped-def]
    """Fill `near` with the walls within reach of the body's origin."""
    balls, frame, start, items = walls
    center[0], center[1], center[2] = x[0], x[1], x[2]
    near[0] = 0
    for n in range(1, 1 + items_near(frame, start, items, x, reach, seen, near[1:])):
        t = near[n]
        bx, by, bz = balls[t, 0] - x[0], balls[t, 1] - x[1], balls[t, 2] - x[2]
        if math.sqrt(bx * bx + by * by + bz * bz) - balls[t, 3] < reach:
            near[0] += 1
            near[near[0]] = t


@njit(cache=True, nogil=True)
def _gather(x, cones, frame, start, items, near, seen, reach):  # type: ignore[no-untyped-def]
    """Fill `near` with the cones within reach of the body's origin."""
    frame[4], frame[5], frame[6] = x[0], x[1], x[2]
    near[0] = 0
    for n in range(1, 1 + items_near(frame, start, items, x, reach, seen, near[1:])):
        c = near[n]
        if _axis_distance(cones[c], x[0], x[1], x[2]) - max(cones[c, 7], cones[c, 8]) < reach:
            near[0] += 1
            near[near[0]] = c


@njit(cache=True, nogil=True)
def _ground_clearance(x, spheres, heights, origin_xy, cell_m):  # type: ignore[no-untyped-def]
    """Smallest height of hull above ground; a rotor counts as a flat disc."""
    tilt = 1.0 - 2.0 * (x[7] * x[7] + x[8] * x[8])  # cosine
    sine = math.sqrt(max(1.0 - tilt * tilt, 0.0))
    best = np.inf
    for s in range(spheres.shape[0]):
        px, py, pz = _to_world(x, spheres[s])
        drop = spheres[s, 3] * (sine if spheres[s, 4] > 0.5 else 1.0)
        best = min(best, pz - drop - _height(heights, origin_xy, cell_m, px, py))
    return best


@njit(cache=True, nogil=True)
def _frustum_distance(cone, px, py, pz):  # type: ignore[no-untyped-def]
    """In the half plane through the axis the frustum is a trapezoid: caps and one slanted side."""
    wx, wy, wz = px - cone[0], py - cone[1], pz - cone[2]
    along = wx * cone[3] + wy * cone[4] + wz * cone[5]
    across = math.sqrt(max(wx * wx + wy * wy + wz * wz - along * along, 0.0))
    length, r0, r1 = cone[6], cone[7], cone[8]
    slope = r1 - r0
    side = math.sqrt(length * length + slope * slope)
    t = min(max(((across - r0) * slope + along * length) / (side * side), 0.0), 1.0)
    to_side = math.hypot(across - r0 - t * slope, along - t * length)
    to_base = math.hypot(max(across - r0, 0.0), along)
    to_tip = math.hypot(max(across - r1, 0.0), along - length)
    nearest = min(to_side, min(to_base, to_tip))
    inside = 0.0 < along < length and across < r0 + slope * along / length
    return -nearest if inside else nearest


@njit(cache=True, nogil=True)
def _axis_distance(cone, px, py, pz):  # type: ignore[no-untyped-def]
    wx, wy, wz = px - cone[0], py - cone[1], pz - cone[2]
    t = min(max(wx * cone[3] + wy * cone[4] + wz * cone[5], 0.0), cone[6])
    dx, dy, dz = wx - t * cone[3], wy - t * cone[4], wz - t * cone[5]
    return math.sqrt(dx * dx + dy * dy + dz * dz)


@njit(cache=True, nogil=True)
def _hull_reach(spheres):  # type: ignore[no-untyped-def]
    far = 0.0
    for s in range(spheres.shape[0]):
        c = spheres[s]
        far = max(far, math.sqrt(c[0] * c[0] + c[1] * c[1] + c[2] * c[2]) + c[3])
    return far


@njit(cache=True, nogil=True)
def _to_world(x, point):  # type: ignore[no-untyped-def]
    """A point of the body in the world: v + 2 w (u x v) + 2 u x (u x v), q = (w, u)."""
    w, a, b, c = x[6], x[7], x[8], x[9]
    tx = 2.0 * (b * point[2] - c * point[1])
    ty = 2.0 * (c * point[0] - a * point[2])
    tz = 2.0 * (a * point[1] - b * point[0])
    return (
        x[0] + point[0] + w * tx + b * tz - c * ty,
        x[1] + point[1] + w * ty + c * tx - a * tz,
        x[2] + point[2] + w * tz + a * ty - b * tx,
    )
