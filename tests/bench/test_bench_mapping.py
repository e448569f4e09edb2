"""Cost of a Mid-360-like scan and of a local map, with OctoMap on the same scans in the same run.

`extra_info` holds the CPU milliseconds (minimum over the rounds) and the ratio; run with
`pytest tests/bench/test_bench_mapping.py --benchmark-json FILE` to keep them.
"""

import math
import time

import numpy as np
import pytest
from pyoctomap import OcTree
from scipy.ndimage import distance_transform_edt

from companion.mapping.distance_field import DistanceField, FieldConfig
from companion.mapping.voxel_map import VoxelMap, VoxelMapConfig

BEAMS, SCANS, RANGE_M = 20_000, 6, 30.0


def beams(number):
    """Directions (BEAMS, 3) of one scan: elevation -7 .. 52 deg, tilted 15 deg forward."""
    i = np.arange(BEAMS) + number * BEAMS
    azimuth = 2 * math.pi * ((i * 0.00731 + 0.31 * np.sin(i * 1e-4)) % 1.0)
    elevation = np.radians(-7 + 59 * np.abs((i * 0.17318) % 2.0 - 1.0))
    flat = np.cos(elevation)
    d = np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)], axis=1)
    c, s = math.cos(math.radians(15)), math.sin(math.radians(15))
    return d @ np.array([[c, 0, -s], [0, 1, 0], [s, 0, c]])


def forest_scan(number):
    """(returns (N, 3), misses (M, 3), origin) in odom axes: ground, 500 trunks, crowns; 0.5 m per scan."""
    rng, origin, d = np.random.default_rng(number), np.array([0.5 * number, 0.0, 2.0]), beams(number)
    reach = np.where(d[:, 2] < -1e-3, origin[2] / np.maximum(-d[:, 2], 1e-3), np.inf)
    flat = np.linalg.norm(d[:, :2], axis=1)
    trunks = np.random.default_rng(7).uniform((-45, -45, 0.1), (45, 45, 0.4), (500, 3))
    for x, y, radius in trunks:
        offset = np.array([x, y]) - origin[:2]
        along = d[:, :2] @ offset / flat
        inside = along**2 - offset @ offset + radius**2
        struck = (inside > 0) & (along > 0) & (offset @ offset > 1.0)
        t = np.where(struck, along - np.sqrt(np.maximum(inside, 0)), np.inf) / flat
        reach = np.minimum(reach, np.where(origin[2] + t * d[:, 2] < 14.0, t, np.inf))
    crown = (rng.uniform(7, 14, BEAMS) - origin[2]) / np.maximum(d[:, 2], 0.1)
    reach = np.where((d[:, 2] > 0.1) & (rng.random(BEAMS) < 0.5), np.minimum(reach, crown), reach)
    seen = reach < 40.0
    return (d[seen] * reach[seen, None]).astype(np.float32), d[~seen].astype(np.float32), origin


@pytest.fixture(scope="module")
def scans():
    return [forest_scan(k) for k in range(SCANS)]


def insert(voxels, scan, *, misses=True):
    points, dirs, origin = scan
    voxels.insert(
        points,
        R_odom_body=np.eye(3),
        p_odom=origin,
        origin_odom=origin,
        miss_dirs_body=dirs if misses else None,
    )


def cpu_ms(work, rounds):
    """Smallest CPU time of one call."""
    taken = []
    for _ in range(rounds):
        started = time.process_time()
        work()
        taken.append(time.process_time() - started)
    return 1e3 * min(taken)


def fly(voxels, scans, **more):
    for scan in scans:
        insert(voxels, scan, **more)


@pytest.mark.parametrize("resolution_m", [0.2, 0.1])
def test_insertion_beside_octomap(benchmark, scans, resolution_m):
    config = VoxelMapConfig(resolution_m=resolution_m, max_range_m=RANGE_M)
    voxels, tree = VoxelMap(config), OcTree(resolution_m)
    fly(voxels, scans)
    alone = VoxelMap(config)
    fly(alone, scans, misses=False)
    ours = cpu_ms(lambda: fly(alone, scans, misses=False), 4) / SCANS
    with_misses = cpu_ms(lambda: fly(voxels, scans), 4) / SCANS
    points, _, origin = scans[0]
    ends = points.astype(np.float64) + origin
    tree.insertPointCloud(ends, origin, RANGE_M, False)
    theirs = cpu_ms(lambda: tree.insertPointCloud(ends, origin, RANGE_M, False), 1)
    benchmark.extra_info.update(
        returns=len(points),
        cpu_ms_returns=round(ours, 2),
        cpu_ms_with_misses=round(with_misses, 2),
        octomap_cpu_ms_returns=round(theirs, 1),
        times_faster=round(theirs / ours, 1),
    )
    print(f"\n{resolution_m} m: {benchmark.extra_info}")
    benchmark.pedantic(insert, args=(voxels, scans[0]), rounds=5)
    assert theirs > 40 * ours  # measured: 110 to 150 times; the margin is for busy machines


def test_local_map_of_40_by_40_by_10_metres(benchmark, scans):
    voxels = VoxelMap(VoxelMapConfig())
    fly(voxels, scans)
    field, center = DistanceField(FieldConfig(), resolution_m=0.2), scans[-1][2]
    seen = field.around(voxels, center, 0).state
    ours = cpu_ms(lambda: field.around(voxels, center, 0), 20)
    theirs = cpu_ms(lambda: [distance_transform_edt(seen != 2), distance_transform_edt(seen == 1)], 3)
    benchmark.extra_info.update(
        cpu_ms=round(ours, 2), scipy_distances_cpu_ms=round(theirs, 1), times_faster=round(theirs / ours, 1)
    )
    print(f"\nlocal map: {benchmark.extra_info}")
    benchmark.pedantic(field.around, args=(voxels, center, 0), rounds=5)
    assert theirs > 5 * ours
