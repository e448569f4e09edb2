"""Worlds of thin things: what of the posts and branches that a LiDAR saw is occupied in the map."""

from __future__ import annotations

import math
from typing import Literal

import numpy as np

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
_NEAR_M, _FAR_M = 3.0, 12.0  # of the things, from the first pose
_THINGS = 150
_TRUNK_RADIUS_M, _BRANCH_RADIUS_M = 0.03, 0.01
_STEP_M = 0.5  # of flight between scans


def thin_world(kind: Thin, *, seed: int) -> Scenery:
    """Flat ground with upright trunks of 6 cm, or with branches of 2 cm across that hang anyhow in the air."""
    rng = np.random.default_rng(seed)
    axis = np.arange(-40.0, 41.0, 1.0)
    angle, away = rng.uniform(0, 2 * math.pi, _THINGS), rng.uniform(_NEAR_M, _FAR_M, _THINGS)
    at = np.column_stack([away * np.cos(angle), away * np.sin(angle), np.zeros(_THINGS)])
    if kind == "trunks":
        lines = tubes(at, at + np.array([0, 0, 6.0]), (np.full(_THINGS, _TRUNK_RADIUS_M),) * 2)
    else:
        starts = at + np.column_stack([np.zeros((_THINGS, 2)), rng.uniform(0.5, 4.5, _THINGS)])
        along = rng.normal(size=(_THINGS, 3))
        along *= (rng.uniform(0.5, 1.5, _THINGS) / np.linalg.norm(along, axis=1))[:, None]
        lines = tubes(starts, starts + along, (np.full(_THINGS, _BRANCH_RADIUS_M),) * 2)
    return join({"ground": sheet((axis, axis), np.zeros((len(axis),) * 2)), kind: lines}, np.zeros(6))


def thin_scans(scenery: Scenery, lidar: Lidar, *, count: int) -> list[Scan]:
    """Scans from a flight over the middle, 2 m up."""
    scene, scans = raycasting(scenery), []
    for number in range(count):
        pose = rotation(0.1 * number, 0.05, 0.02), np.array([_STEP_M * number, 0.0, 2.0])
        scans.append(look(scene, beams_of(lidar, number), pose, np.random.default_rng([number, 78])))
    return scans


def thin_recall(kind: Thin, lidar: Lidar, resolution_m: float, *, count: int = 3) -> dict[str, float]:
    """Share of the voxels that held a return of a thing in any scan and are occupied after all of them.

    Ours is with the sensor model that flies; OctoMap's is with its own.
    """
    scenery = thin_world(kind, seed=11)
    scans = thin_scans(scenery, lidar, count=count)
    voxels = VoxelMap(VoxelMapConfig(resolution_m=resolution_m, max_range_m=RANGE_M))
    tree = OctoMap(resolution_m, RANGE_M)
    for scan in scans:
        scan.into(voxels)
        tree.insertion(scan)()
    seen = _seen(scans, scenery.first[kind], resolution_m)
    ours, theirs = voxels.classify(seen) == OCCUPIED_CELL, tree.classes(seen) == OCCUPIED_CELL
    return {
        "recall": float(ours.mean()),
        "octomap_recall": float(theirs.mean()),
        "seen_voxels": float(len(seen)),
        "scans": float(count),
    }


def _seen(scans: list[Scan], first: int, resolution_m: float) -> Array:
    """Centres of the voxels with a return of a thing (triangles from `first` on), once each."""
    points = np.concatenate([s.points_odom[s.surface >= first] for s in scans])
    cells = np.unique(np.floor(points / resolution_m).astype(np.int64), axis=0)
    return np.asarray((cells + 0.5) * resolution_m)
