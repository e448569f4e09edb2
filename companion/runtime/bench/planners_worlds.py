"""Worlds in which the planners are compared: a plane maze, and in space a forest, two walls with windows, a maze.

for world in (make_world(name) for name in WORLDS):
    print(world.name, world.space.bounds, len(world.ends))
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt, label

from companion.core.errors import InputError
from companion.core.messages import Array, LocalMap, freeze
from companion.planning.grid_space import GridSpace
from companion.planning.planner import CellSpace
from companion.planning.space import FieldSpace

RESOLUTION_M, RADIUS_M = 0.2, 0.4
_SIDE_M, _HEIGHT_M = 60.0, 10.0
_FIELD_M = 2.0  # the distance field ends here, as the vehicle's own
_ROOM_M, _ROOMS, _WALL_M = 5.0, 12, 0.4  # of the mazes
Occupied = NDArray[np.bool_]


@dataclass(frozen=True, slots=True, eq=False)
class World:
    """A space, and pairs of start and goal (P, 2, 3), odom, m."""

    name: str
    title: str
    space: CellSpace
    ends: Array

    @property
    def plane(self) -> bool:
        """Is it of one layer?"""
        return int(self.space.steps.shape[2]) == 1


def make_world(name: str, *, pairs: int = 3) -> World:
    """One of WORLDS with so many pairs of ends, all of them joined by some way; the same each time."""
    if name not in WORLDS:
        raise InputError(f"{name!r} is no world", field="worlds", valid=", ".join(WORLDS))
    title, build, where = WORLDS[name]
    rng = np.random.default_rng(sum(name.encode()))
    space = _space(build(rng))
    joined, _ = label(space.steps > 0)
    ends: list[Array] = []
    while len(ends) < pairs:
        pair = rng.uniform(*np.array(where).transpose(1, 0, 2))
        if space.steps.shape[2] == 1:
            pair[:, 2] = 0.5 * RESOLUTION_M
        parts = joined[tuple(np.floor(space.to_cells(pair)).astype(int).T)]
        if parts[0] > 0 and parts[0] == parts[1] and not space.segment_free(*pair):
            ends.append(pair)
    return World(name, title, space, np.array(ends))


def _space(occupied: Occupied) -> CellSpace:
    """Room for a sphere of RADIUS_M; the outermost cells' borders are no obstacles."""
    gap = (distance_transform_edt(~occupied) - 0.5) * RESOLUTION_M
    if occupied.ndim == 2:
        return GridSpace(gap < RADIUS_M, resolution_m=RESOLUTION_M, distance_m=gap)
    distance = np.clip(gap, 0.0, _FIELD_M).astype(np.float32)
    local_map = LocalMap(
        stamp_ns=0,
        origin_odom=np.zeros(3),
        resolution_m=RESOLUTION_M,
        state=np.where(occupied, 2, 1).astype(np.uint8),
        distance_m=distance,
        unknown_distance_m=distance,
        ground_z_odom=np.zeros(occupied.shape[:2], np.float32),
    )
    return FieldSpace(freeze(local_map), radius_m=RADIUS_M)


def empty_world(*, plane: bool = False) -> Occupied:
    """Ground and nothing on it, or an empty plane."""
    side = round(_SIDE_M / RESOLUTION_M)
    if plane:
        return np.zeros((side, side), bool)
    occupied = np.zeros((side, side, round(_HEIGHT_M / RESOLUTION_M)), bool)
    occupied[:, :, 0] = True
    return occupied


def fill_box(occupied: Occupied, low: tuple[float, ...], high: tuple[float, ...], value: bool = True) -> None:
    """A box, m; a plane world takes the first two numbers."""
    part = [slice(max(round(a / RESOLUTION_M), 0), round(b / RESOLUTION_M)) for a, b in zip(low, high, strict=True)]
    occupied[tuple(part[: occupied.ndim])] = value


def forest(rng: np.random.Generator, trees_per_m2: float = 1 / 25, *, crowns: bool = True) -> Occupied:
    """Leaning trunks of 0.15 to 0.35 m radius; crowns of three balls each."""
    occupied = empty_world()
    for _ in range(rng.poisson(trees_per_m2 * _SIDE_M**2)):
        foot, radius = rng.uniform(0, _SIDE_M, 2), rng.uniform(0.15, 0.35)
        lean = np.tan(rng.uniform(0, np.radians(10))) * _direction(rng)
        for k in range(occupied.shape[2]):
            z = (k + 0.5) * RESOLUTION_M
            _ball(occupied, np.array([*(foot + lean * z), z]), radius * (1 - 0.04 * z) + 0.3 * RESOLUTION_M)
        for _ in range(3 if crowns else 0):
            z = rng.uniform(5.0, 9.5)
            _ball(occupied, np.array([*(foot + lean * z + rng.normal(0, 0.6, 2)), z]), rng.uniform(0.5, 1.3))
    return occupied


def _direction(rng: np.random.Generator) -> Array:
    turn = rng.uniform(0, 2 * np.pi)
    return np.array([np.cos(turn), np.sin(turn)])


def _ball(occupied: Occupied, center: Array, radius: float) -> None:
    low = np.maximum(np.floor((center - radius) / RESOLUTION_M), 0).astype(int)
    high = np.minimum(np.floor((center + radius) / RESOLUTION_M) + 1, occupied.shape).astype(int)
    if np.any(high <= low):
        return
    axes = [((np.arange(a, b) + 0.5) * RESOLUTION_M - c) ** 2 for a, b, c in zip(low, high, center, strict=True)]
    near = axes[0][:, None, None] + axes[1][None, :, None] + axes[2][None, None, :] <= radius**2
    occupied[low[0] : high[0], low[1] : high[1], low[2] : high[2]] |= near


def _windows(rng: np.random.Generator) -> Occupied:
    """A thin forest behind two walls with one window of 1.6 m each, at opposite sides and heights."""
    occupied = forest(rng, 1 / 100, crowns=False)
    for x, y, z in ((22.0, 44.0, 7.0), (38.0, 14.0, 2.0)):
        fill_box(occupied, (x - 1.0, 0, 0), (x + 1.4, _SIDE_M, _HEIGHT_M), False)
        fill_box(occupied, (x, 0, 0), (x + 0.4, _SIDE_M, _HEIGHT_M))
        fill_box(occupied, (x, y - 0.8, z - 0.8), (x + 0.4, y + 0.8, z + 0.8), False)
    return occupied


def _maze(rng: np.random.Generator) -> Occupied:
    return _walls(empty_world(), rng)


def _maze_2d(rng: np.random.Generator) -> Occupied:
    return _walls(empty_world(plane=True), rng)


def _walls(occupied: Occupied, rng: np.random.Generator) -> Occupied:
    """A maze of rooms; in space one wall in six leaves a slit below or above, in the plane one in twelve is missing."""
    for axis, walls in enumerate(_closed_walls(rng)):
        for place in np.argwhere(walls):
            low, high = place * _ROOM_M, (place + 1) * _ROOM_M
            low[axis], high[axis] = high[axis] - _WALL_M / 2, high[axis] + _WALL_M / 2
            low[1 - axis], high[1 - axis] = low[1 - axis] - _WALL_M / 2, high[1 - axis] + _WALL_M / 2
            luck = rng.random()
            if occupied.ndim == 2 and luck < 1 / 12:
                continue
            bottom, top = (0.0, 7.5) if luck < 1 / 12 else (2.6, _HEIGHT_M) if luck < 1 / 6 else (0.0, _HEIGHT_M)
            fill_box(occupied, (*low, bottom), (*high, top))
    return occupied


def _closed_walls(rng: np.random.Generator) -> tuple[Occupied, Occupied]:
    """Walls that a depth-first walk through all rooms leaves: (after room i, j along x), (along y)."""
    walls = (np.ones((_ROOMS, _ROOMS), bool), np.ones((_ROOMS, _ROOMS), bool))
    walls[0][-1], walls[1][:, -1] = False, False
    seen, way = np.zeros((_ROOMS, _ROOMS), bool), [(0, 0)]
    seen[0, 0] = True
    while way:
        i, j = way[-1]
        around = [(a, b) for a, b in ((i + 1, j), (i - 1, j), (i, j + 1), (i, j - 1))
                  if 0 <= a < _ROOMS and 0 <= b < _ROOMS and not seen[a, b]]  # fmt: skip
        if not around:
            way.pop()
            continue
        a, b = around[int(rng.integers(len(around)))]
        walls[0 if a != i else 1][min(i, a), min(j, b)] = False
        seen[a, b] = True
        way.append((a, b))
    return walls


_ACROSS = (((1.5, 5, 1.2), (3, 55, 4)), ((57, 5, 1.2), (58.5, 55, 4)))  # low and high corners of starts, of goals
_CORNERS = (((1, 1, 2), (4, 4, 8)), ((56, 56, 2), (59, 59, 8)))
WORLDS: dict[str, tuple[str, Callable[[np.random.Generator], Occupied], tuple[tuple[tuple[float, ...], ...], ...]]] = {
    "maze_2d": ("maze in the plane, 60 x 60 m", _maze_2d, _CORNERS),
    "forest": ("forest, 1 tree per 25 m2, 60 x 60 x 10 m", forest, _ACROSS),
    "windows": ("two walls with a window each", _windows, _ACROSS),
    "maze": ("maze in space", _maze, _CORNERS),
}
