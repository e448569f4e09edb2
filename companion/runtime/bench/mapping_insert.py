"""Insertion beside OctoMap: CPU time per scan, and how far the two maps agree."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from itertools import product

import numpy as np
from numpy.typing import NDArray

from companion.core.messages import Array
from companion.mapping.voxel_map import VoxelMap, VoxelMapConfig
from companion.runtime.bench.mapping_peers import OCTOMAP_MODEL, Insertion, OctoMap, Prototype, RayPer, cpu_ms
from companion.runtime.bench.mapping_scans import Scan

RANGE_M = 30.0
_BLOCKS = 512  # blocks of voxels asked for at once
_NEAR = np.array(list(product((-1, 0, 1), repeat=3)))


def like_octomap(resolution_m: float, ray_per: RayPer = "point") -> VoxelMapConfig:
    """Our map with OctoMap's sensor model."""
    return VoxelMapConfig(resolution_m=resolution_m, max_range_m=RANGE_M, ray_per=ray_per, sensor=OCTOMAP_MODEL)


def time_insertion(
    scans: list[Scan],
    resolution_m: float,
    *,
    rounds: int,
    ray_per: RayPer = "point",
    prototype: Prototype | None = None,
) -> dict[str, float]:
    """CPU ms per scan of both, in turns; the first scan, which fills an empty map, stands apart.

    Each round fills a new map and a new tree. Of each scan the smallest time over the rounds counts, then the
    mean over the scans. A `prototype` takes its turn, too.
    """
    taken = np.full((2 if prototype is None else 3, len(scans)), np.inf)
    for _ in range(rounds):
        voxels, tree = VoxelMap(like_octomap(resolution_m, ray_per)), OctoMap(resolution_m, RANGE_M, ray_per=ray_per)
        insertions: list[Insertion] = [lambda scan, to=voxels: partial(scan.into, to), tree.insertion]  # type: ignore[misc]
        insertions += [] if prototype is None else [prototype.empty(resolution_m, RANGE_M)]
        for k, scan in enumerate(scans):
            works = [insertion(scan) for insertion in insertions]
            taken[:, k] = np.minimum(taken[:, k], [cpu_ms(work) for work in works])
    later = taken[:, 1:].mean(axis=1)
    figures = {
        "ours_ms": float(later[0]),
        "peer_ms": float(later[1]),
        "first_ours_ms": float(taken[0, 0]),
        "first_peer_ms": float(taken[1, 0]),
        "returns": float(np.mean([len(s.points_body) for s in scans[1:]])),
        "rounds": float(rounds),
    }
    if prototype is None:
        return figures
    return figures | {"prototype_ms": float(later[2]), "prototype_ratio": float(later[1] / later[2])}


def time_threads(scans: list[Scan], resolution_m: float, *, rounds: int) -> dict[str, float]:
    """Wall ms per scan of one thread and of two, in turns, and 1 if both give the same map.

    As `time_insertion` otherwise. What a second thread gains depends on whether a core is free for it.
    """
    taken = np.full((2, len(scans)), np.inf)
    with ThreadPoolExecutor(2) as threads:
        for _ in range(rounds):
            config = like_octomap(resolution_m)
            maps = VoxelMap(config), VoxelMap(config, map_pool=threads.map)
            for k, scan in enumerate(scans):
                taken[:, k] = np.minimum(taken[:, k], [_wall_ms(partial(scan.into, voxels)) for voxels in maps])
    one, two = (voxels.to_arrays() for voxels in maps)
    one_ms, two_ms = taken[:, 1:].mean(axis=1)
    same = all(np.array_equal(one[name], two[name]) for name in one)
    figures = {"one_thread_wall_ms": float(one_ms), "two_threads_wall_ms": float(two_ms)}
    return figures | {"same_map": float(same), "rounds": float(rounds)}


def _wall_ms(work: Callable[[], object]) -> float:
    started = time.perf_counter_ns()
    work()
    return (time.perf_counter_ns() - started) * 1e-6


def agreement(scans: Iterable[Scan], resolution_m: float, *, ray_per: RayPer = "point") -> dict[str, float]:
    """Both maps after all scans, over the voxels that either knows.

    `agreement`: same class; `free_recall`, `occupied_recall`: share of OctoMap's that are ours,
    too; `occupied_precision`: share of our occupied that are occupied in OctoMap.
    """
    voxels, tree = VoxelMap(like_octomap(resolution_m, ray_per)), OctoMap(resolution_m, RANGE_M, ray_per=ray_per)
    count = 0
    for scan in scans:
        scan.into(voxels)
        tree.insertion(scan)()
        count += 1
    pairs = np.zeros((3, 3), np.int64)  # their class, our class
    for centers in _centers(voxels):
        pairs += np.bincount(3 * tree.classes(centers) + voxels.classify(centers), minlength=9).reshape(3, 3)
    known = pairs.sum() - pairs[0, 0]
    return {
        "agreement": float((pairs[1, 1] + pairs[2, 2]) / known),
        "free_recall": float(pairs[1, 1] / pairs[1].sum()),
        "occupied_recall": float(pairs[2, 2] / pairs[2].sum()),
        "occupied_precision": float(pairs[2, 2] / pairs[:, 2].sum()),
        "known_voxels": float(known),
        "scans": float(count),
    }


def _centers(voxels: VoxelMap) -> Iterator[Array]:
    """Centres of all voxels of our blocks and of the blocks around them, where rays may differ."""
    xyz: NDArray[np.int32] = voxels.to_arrays()["block_xyz"]
    blocks = np.unique((xyz[:, None] + _NEAR).reshape(-1, 3), axis=0)
    inside = np.array(list(product(range(8), repeat=3))) + 0.5
    for first in range(0, len(blocks), _BLOCKS):
        cells = 8 * blocks[first : first + _BLOCKS, None] + inside
        yield cells.reshape(-1, 3) * voxels.resolution_m
