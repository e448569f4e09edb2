"""Worlds of `companion bench planning`: forests, hard shapes, and real maps in which what is unknown is blocked.

for name in PLANNING_WORLDS:
    world = planning_world(name, data=Path("data"))
    print(world.name, world.space.steps.shape, len(world.ends))
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt, label

from companion.core.errors import InputError
from companion.core.messages import Array, LocalMap, freeze
from companion.mapping.rays import BLOCK
from companion.planning.space import FieldSpace
from companion.runtime.bench.planners_worlds import (
    RADIUS_M,
    RESOLUTION_M,
    Occupied,
    World,
    empty_world,
    fill_box,
    forest,
    make_world,
)
from companion.runtime.map_file import read_map

PAIRS = 5  # of ends per world
_FIELD_M = 2.0  # the distance field ends here, as the vehicle's own
_FAR_M = 15.0  # ends in the real maps are at least so far apart
_ACROSS = (((1.5, 5, 1.2), (3, 55, 4)), ((57, 5, 1.2), (58.5, 55, 4)))  # low and high corners of starts, of goals
_TRAPPED = (((30, 18, 2), (38, 42, 8)), ((48, 20, 2), (58, 40, 8)))
_REAL = {  # file, radius of the vehicle
    "geb079": ("map_octomap_share/geb079.bt", 0.25),
    "manufacturing": ("map_bt_upo/manufacturing.bt", 0.25),
    "maze_upo": ("map_bt_upo/maze.bt", 0.4),
    "mbzirc": ("map_bt_upo/mbzirc_challenge3.bt", 0.4),
}
FORESTS = ("forest_49", "forest_36", "forest_25", "forest_16")
HARD = ("window", "maze", "bug_trap", *_REAL)
PLANNING_WORLDS = (*FORESTS, *HARD)


def planning_world(name: str, *, data: Path) -> World:
    """One of PLANNING_WORLDS with PAIRS of ends that are joined but not in sight; the same each time.

    Raises InputError for another name, and if the file of a real map is not in the folder `data`.
    """
    if name in ("window", "maze"):
        return make_world({"window": "windows"}.get(name, name), pairs=PAIRS)
    if name in _REAL:
        file, radius_m = _REAL[name]
        blocked, resolution_m = _blocked_of(data / file)
        space = space_of(blocked, resolution_m, radius_m=radius_m)
        return World(name, f"{Path(file).stem}, real map", space, _ends_in(space, name))
    if name in _MADE:
        title, build, where = _MADE[name]
        space = space_of(build(np.random.default_rng(_seed(name))), RESOLUTION_M, radius_m=RADIUS_M)
        return World(name, title, space, _ends_between(space, name, where))
    raise InputError(f"{name!r} is no world", field="worlds", valid=", ".join(PLANNING_WORLDS))


def enclosed_goal() -> tuple[FieldSpace, Array]:
    """A forest with a closed hut, and (2, 3) a start outside and a goal inside it."""
    occupied = forest(np.random.default_rng(7), 1 / 25)
    fill_box(occupied, (44, 24, 0), (56, 36, 8), True)
    fill_box(occupied, (44.4, 24.4, 0.2), (55.6, 35.6, 7.6), False)
    space = space_of(occupied, RESOLUTION_M, radius_m=RADIUS_M)
    return space, np.array([[2.0, 30.0, 2.0], [50.0, 30.0, 2.0]])


def space_of(occupied: Occupied, resolution_m: float, *, radius_m: float) -> FieldSpace:
    """Room for a sphere; the outermost cells' borders are no obstacles."""
    gap = (distance_transform_edt(~occupied) - 0.5) * resolution_m
    distance = np.clip(gap, 0.0, _FIELD_M).astype(np.float32)
    local_map = LocalMap(
        stamp_ns=0,
        origin_odom=np.zeros(3),
        resolution_m=resolution_m,
        state=np.where(occupied, 2, 1).astype(np.uint8),
        distance_m=distance,
        unknown_distance_m=distance,
        ground_z_odom=np.zeros(occupied.shape[:2], np.float32),
    )
    return FieldSpace(freeze(local_map), radius_m=radius_m)


def _blocked_of(path: Path) -> tuple[Occupied, float]:
    """Cells that are not known free, within the box of what is known free and a rim."""
    stored = read_map(path)
    low = stored.block_xyz.min(axis=0)
    size = (stored.block_xyz.max(axis=0) - low + 1) * BLOCK
    blocked = np.ones(size, bool)
    tiles = blocked.reshape(size[0] // BLOCK, BLOCK, size[1] // BLOCK, BLOCK, size[2] // BLOCK, BLOCK)
    i, j, k = (stored.block_xyz - low).T
    free = (stored.log_odds < 0) & (stored.log_odds > np.iinfo(np.int8).min)
    tiles[i, :, j, :, k, :] = ~free.reshape(-1, BLOCK, BLOCK, BLOCK)
    spans = [np.flatnonzero(~blocked.all(axis=tuple(a for a in range(3) if a != axis))) for axis in range(3)]
    trimmed = blocked[tuple(slice(max(span[0] - 1, 0), span[-1] + 2) for span in spans)]
    return np.ascontiguousarray(trimmed), stored.resolution_m


def _ends_in(space: FieldSpace, name: str) -> Array:
    """Far pairs in the largest free part of a real map."""
    rng = np.random.default_rng(_seed(name))
    joined, _ = label(space.steps > 0)
    largest = int(np.argmax(np.bincount(joined.ravel())[1:])) + 1
    cells = np.argwhere(joined == largest)
    ends: list[Array] = []
    while len(ends) < PAIRS:
        pair = space.to_odom(cells[rng.integers(len(cells), size=2)].astype(np.float64) + 0.5)
        if np.linalg.norm(pair[1] - pair[0]) >= _FAR_M and not space.segment_free(*pair):
            ends.append(pair)
    return np.array(ends)


def _ends_between(space: FieldSpace, name: str, where: tuple[tuple[tuple[float, ...], ...], ...]) -> Array:
    """Pairs in two boxes."""
    rng = np.random.default_rng([_seed(name), 1])
    joined, _ = label(space.steps > 0)
    ends: list[Array] = []
    while len(ends) < PAIRS:
        pair = rng.uniform(*np.array(where).transpose(1, 0, 2))
        parts = joined[tuple(np.floor(space.to_cells(pair)).astype(int).T)]
        if parts[0] > 0 and parts[0] == parts[1] and not space.segment_free(*pair):
            ends.append(pair)
    return np.array(ends)


def _seed(name: str) -> int:
    return sum(name.encode())


def _bug_trap(_: np.random.Generator) -> NDArray[np.bool_]:
    """A box whose mouth has lips turned inwards; the start is in it, the goal behind it."""
    occupied = empty_world()
    for low, high in (
        ((10, 15, 0), (40, 15.4, 10)), ((10, 45, 0), (40, 45.4, 10)), ((40, 15, 0), (40.4, 45.4, 10)),
        ((10, 15, 0), (10.4, 28.8, 10)), ((10, 31.2, 0), (10.4, 45.4, 10)),
        ((10, 28.4, 0), (22, 28.8, 10)), ((10, 31.2, 0), (22, 31.6, 10)),
    ):  # fmt: skip
        fill_box(occupied, low, high, True)
    return occupied


_Made = tuple[str, Callable[[np.random.Generator], Occupied], tuple[tuple[tuple[float, ...], ...], ...]]
_MADE: dict[str, _Made] = {
    **{
        f"forest_{n}": (f"forest, 1 tree per {n} m2", partial(forest, trees_per_m2=1 / n), _ACROSS)
        for n in (49, 36, 25, 16)
    },
    "bug_trap": ("bug trap", _bug_trap, _TRAPPED),
}
