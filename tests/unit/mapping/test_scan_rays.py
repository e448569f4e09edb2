"""Which voxels a scan updates: those of the textbook's traversal, by one thread or two, per point or per voxel."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pyoctomap import OcTree

from companion.mapping.sensor_model import SensorModel, quantise
from companion.mapping.voxel_map import VoxelMap, VoxelMapConfig
from tests.unit.mapping.reference_rays import expected_map, known_voxels, random_scan, room_scans

OCTOMAP = SensorModel(hit=0.7, miss=0.4, lowest=0.12, highest=0.97)


def config(**changes):
    return VoxelMapConfig(**{"max_range_m": 8.0, "miss_clear_range_m": 5.0} | changes)


def insert(voxels, scan):
    points, misses, R, p, origin = scan
    return voxels.insert(points, R_odom_body=R, p_odom=p, origin_odom=origin, miss_dirs_body=misses)


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from([0.05, 0.13, 0.2, 1.0]), st.sampled_from(["point", "end_voxel"]))
def test_every_voxel_of_random_scans_is_that_of_amanatides_and_woo(seed, resolution_m, ray_per):
    rng = np.random.default_rng(seed)
    scans = [random_scan(rng, 60, 15) for _ in range(2)] * 2
    voxels = VoxelMap(config(resolution_m=resolution_m, ray_per=ray_per))
    for scan in scans:
        delta = insert(voxels, scan)
        assert (delta.returns, delta.misses, delta.dropped) == (60, 15, 0)
    assert known_voxels(voxels) == expected_map(scans, voxels.config, quantise(voxels.config.sensor))


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(0, 70), st.sampled_from(["point", "end_voxel"]))
def test_two_threads_give_the_map_and_the_counts_of_one(seed, returns, ray_per):
    rng = np.random.default_rng(seed)
    one = VoxelMap(config(ray_per=ray_per))
    with ThreadPoolExecutor(2) as threads:
        two = VoxelMap(config(ray_per=ray_per), map_pool=threads.map)
        for _ in range(4):
            scan = random_scan(rng, returns, rng.integers(0, 40))
            alone, shared = insert(one, scan), insert(two, scan)
            assert (alone.returns, alone.misses, alone.dropped) == (shared.returns, shared.misses, shared.dropped)
            assert (alone.voxel_steps, alone.blocks_met) == (shared.voxel_steps, shared.blocks_met)
            assert np.array_equal(alone.changed_blocks, shared.changed_blocks)
    for name, array in one.to_arrays().items():
        assert array.tobytes() == two.to_arrays()[name].tobytes(), name


def test_two_threads_fly_through_a_room_as_one():
    """Thousands of rays that meet the same voxels from both halves of the scan."""
    one = VoxelMap(config())
    with ThreadPoolExecutor(2) as threads:
        two = VoxelMap(config(), map_pool=threads.map)
        for origin, ends in room_scans(np.random.default_rng(8), 6, 6000):
            scan = ((ends - origin).astype(np.float32), np.eye(3, dtype=np.float32), np.eye(3), origin, origin)
            insert(one, scan)
            insert(two, scan)
            assert not any(bits.any() for bits in two._rays._other.bits)
    assert known_voxels(one) == known_voxels(two)


@pytest.mark.parametrize("resolution_m", [0.1, 0.2])
def test_one_ray_per_end_voxel_agrees_with_the_discrete_mode_of_octomap(resolution_m):
    """At least 99.9 % of all known voxels have the same class; and it is another map than that of a ray per point."""
    voxels, tree = (
        VoxelMap(config(resolution_m=resolution_m, ray_per="end_voxel", sensor=OCTOMAP)),
        OcTree(resolution_m),
    )
    every = VoxelMap(config(resolution_m=resolution_m, sensor=OCTOMAP))
    tree.setClampingThresMin(0.12)
    tree.setClampingThresMax(0.97)
    for origin, ends in room_scans(np.random.default_rng(5), 8, 2500):
        origin = origin.astype(np.float32).astype(np.float64)
        scan = ((ends - origin).astype(np.float32), np.empty((0, 3), np.float32), np.eye(3), origin, origin)
        insert(voxels, scan)
        insert(every, scan)
        tree.insertPointCloud(ends, origin, 8.0, False, True)
    axes = [np.arange(-n, n) * resolution_m + resolution_m / 2 for n in np.ceil(np.array([7.5, 6.5, 3]) / resolution_m)]
    centers = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    theirs = np.asarray(tree.getLabels(centers)).ravel() + 1  # they count from -1, unknown
    ours, known = voxels.classify(centers), theirs > 0
    assert known.sum() > 30_000
    assert np.mean(ours[known | (ours > 0)] == theirs[known | (ours > 0)]) >= 0.999
    assert np.mean(ours[theirs == 2] == 2) >= 0.999
    assert np.mean(every.classify(centers)[known] == theirs[known]) < 0.999


def test_one_ray_per_end_voxel_counts_all_points_and_crosses_less():
    rng = np.random.default_rng(3)
    scan = random_scan(rng, 400, 10)
    points = (scan[0][:, None] + rng.normal(0, 0.02, (400, 5, 3))).reshape(-1, 3).astype(np.float32)
    points[7] = np.nan
    deltas = [insert(VoxelMap(config(ray_per=per)), (points, *scan[1:])) for per in ("point", "end_voxel")]
    assert [(d.returns, d.misses, d.dropped) for d in deltas] == [(1999, 10, 1)] * 2
    assert deltas[1].voxel_steps < 0.6 * deltas[0].voxel_steps
