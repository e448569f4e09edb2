"""Worlds of thin things: what of the posts and branches that a LiDAR saw is occupied in the map."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from companion.core.messages import Array
from companion.mapping.voxel_map import OCCUPIED_CELL, VoxelMap, VoxelMapConfig
from companion.runtime.bench.mapping_forest import (
    Lidar,
    Scenery,
    beams_of,
    join,
    look,
    raycasting,
    rotation,
    sheet,
    tubes,
)
from companion.runtime.bench.mapping_insert import RANGE_M
from companion.runtime.bench.mapping_peers import OctoMap
from companion.runtime.bench.mapping_scans import Scan

Thin = Literal["trunks", "branches"]
_Classes = Callable[[Array], NDArray[np.uint8]]
_THINGS = 250
_AHEAD_M, _ASIDE_M, _CLEAR_M = 24.0, 12.0, 1.5  # where they stand, and how far from the way
_TRUNK_RADIUS_M, _BRANCH_RADIUS_M = 0.03, 0.01
_STEP_M = 0.3  # of flight between scans: 3 m/s at 10 Hz
_FLOWN, _LAST = 30, 3  # scans
_SEEN_M = 15.0  # returns from farther do not count as seen


def thin_world(kind: Thin, *, seed: int) -> Scenery:
    """Flat ground with upright trunks of 6 cm, or with branches of 2 cm across that hang anyhow in the air."""
    rng = np.random.default_rng(seed)
    axis = np.arange(-40.0, 61.0, 1.0)
    aside = rng.uniform(_CLEAR_M, _ASIDE_M, _THINGS) * rng.choice([-1.0, 1.0], _THINGS)
    at = np.column_stack([rng.uniform(-5.0, _AHEAD_M, _THINGS), aside, np.zeros(_THINGS)])
    if kind == "trunks":
        lines = tubes(at, at + np.array([0, 0, 6.0]), (np.full(_THINGS, _TRUNK_RADIUS_M),) * 2)
    else:
        starts = at + np.column_stack([np.zeros((_THINGS, 2)), rng.uniform(0.5, 4.5, _THINGS)])
        along = rng.normal(size=(_THINGS, 3))
        along *= (rng.uniform(0.5, 1.5, _THINGS) / np.linalg.norm(along, axis=1))[:, None]
        lines = tubes(starts, starts + along, (np.full(_THINGS, _BRANCH_RADIUS_M),) * 2)
    return join({"ground": sheet((axis, axis), np.zeros((len(axis),) * 2)), kind: lines}, np.zeros(6))


def thin_scans(scenery: Scenery, lidar: Lidar, *, count: int) -> list[Scan]:
    """Scans from a flight between the things, 2 m up."""
    scene, scans = raycasting(scenery), []
    for number in range(count):
        pose = rotation(0.01 * number, 0.05, 0.02), np.array([_STEP_M * number, 0.0, 2.0])
        scans.append(look(scene, beams_of(lidar, number), pose, np.random.default_rng([number, 78])))
    return scans


def thin_recall(kind: Thin, lidar: Lidar, resolution_m: float) -> dict[str, float]:
    """Share of the voxels that held a return of a thing, from up to 15 m, in three scans and are occupied after them.

    `recall`: in an empty map, where a miss or two cannot outweigh a hit. `flown_recall`: in the map of the 30 scans of
    a flight between the things, of which these are the last: most made free what has a return now. `kept_recall`:
    then, of what any of the 30 saw. Ours is with the sensor model that flies; OctoMap's is with its own.
    """
    scenery = thin_world(kind, seed=11)
    scans = thin_scans(scenery, lidar, count=_FLOWN)
    last, first = scans[-_LAST:], scenery.first[kind]
    fresh, flown = _filled(last, resolution_m), _filled(scans, resolution_m)
    figures: dict[str, float] = {}
    for name, maps, asked in (("", fresh, last), ("flown_", flown, last), ("kept_", flown, scans)):
        seen = _seen(asked, first, resolution_m)
        ours, theirs = (float(np.mean(classes(seen) == OCCUPIED_CELL)) for classes in maps)
        figures |= {f"{name}recall": ours, f"octomap_{name}recall": theirs, f"{name}seen_voxels": float(len(seen))}
    return figures


def _filled(scans: Sequence[Scan], resolution_m: float) -> tuple[_Classes, _Classes]:
    """What tells the classes of voxels in a map of all scans, ours and OctoMap's."""
    voxels = VoxelMap(VoxelMapConfig(resolution_m=resolution_m, max_range_m=RANGE_M))
    tree = OctoMap(resolution_m, RANGE_M)
    for scan in scans:
        scan.into(voxels)
        tree.insertion(scan)()
    return voxels.classify, tree.classes


def _seen(scans: Sequence[Scan], first: int, resolution_m: float) -> Array:
    """Centres of the voxels with a return of a thing (triangles from `first` on), once each."""
    near = [(s.surface >= first) & (np.linalg.norm(s.points_body, axis=1) <= _SEEN_M) for s in scans]
    points = np.concatenate([s.points_odom[mask] for s, mask in zip(scans, near, strict=True)])
    cells = np.unique(np.floor(points / resolution_m).astype(np.int64), axis=0)
    return np.asarray((cells + 0.5) * resolution_m)
