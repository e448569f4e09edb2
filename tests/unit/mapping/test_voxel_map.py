"""Laws of the voxel map: exact ray voxels, OctoMap's update, growth, storage."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pyoctomap import OcTree

from companion.core.errors import InputError
from companion.mapping.sensor_model import SensorModel, quantise
from companion.mapping.voxel_map import VoxelMap, VoxelMapConfig
from tests.unit.mapping.reference_rays import known_voxels, room_scans

STEPS = quantise(SensorModel())
ORIGIN = np.array([0.31, -0.17, 1.53])


def small(**changes):
    return VoxelMap(VoxelMapConfig(**{"max_range_m": 8.0, "miss_clear_range_m": 5.0} | changes))


def look(voxels, points_odom, *, origin=ORIGIN, misses=None, **more):
    """One scan given by its end points in odom."""
    points = (np.asarray(points_odom, np.float64) - origin).astype(np.float32).reshape(-1, 3)
    return voxels.insert(
        points, R_odom_body=np.eye(3), p_odom=origin, origin_odom=origin, miss_dirs_body=misses, **more
    )


_SHARED = small()


def test_classes_agree_with_octomap():
    """Same scans through pyoctomap: at least 99.9 % of all known voxels have the same class."""
    voxels, tree = small(sensor=SensorModel(hit=0.7, miss=0.4, lowest=0.12, highest=0.97)), OcTree(0.2)
    for probability, setter in ((0.7, tree.setProbHit), (0.4, tree.setProbMiss)):
        setter(probability)
    tree.setClampingThresMin(0.12)
    tree.setClampingThresMax(0.97)
    for origin, ends in room_scans(np.random.default_rng(5), 12, 2500):
        origin = origin.astype(np.float32).astype(np.float64)
        look(voxels, ends, origin=origin)
        tree.insertPointCloud(ends, origin, 8.0, False)
    axes = [np.arange(-45, 45) * 0.2 + 0.1] * 3
    centers = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    theirs = np.asarray(tree.getLabels(centers)).ravel() + 1  # they count from -1, unknown
    ours = voxels.classify(centers)
    known = (ours > 0) | (theirs > 0)
    assert known.sum() > 50_000
    assert np.mean(ours[known] == theirs[known]) >= 0.999
    assert np.mean(ours[theirs == 2] == 2) >= 0.99  # the occupied ones alone, too


def test_one_hit_on_the_unknown_is_occupied_and_its_ray_is_free():
    voxels = small()
    end = ORIGIN + np.array([3.0, 0.4, 0.2])
    look(voxels, end)
    assert voxels.classify(np.array([end])) == [2]
    assert voxels.classify(ORIGIN + np.linspace(0, 0.9, 30)[:, None] * (end - ORIGIN)).tolist() == [1] * 30
    assert voxels.classify(np.array([end + np.array([0.5, 0, 0])])) == [0]
    assert voxels.query(np.array([end]))[0] == pytest.approx(STEPS.hit / STEPS.per_unit)
    assert np.isnan(voxels.query(np.array([end + np.array([0.5, 0, 0])]))[0])


def test_a_hit_wins_over_the_rays_of_the_same_scan():
    voxels = small()
    near = ORIGIN + np.array([2.0, 0.0, 0.0])
    look(voxels, np.concatenate([[near], ORIGIN + np.array([4.0, 0.0, 0.0]) + np.zeros((50, 3))]))
    assert voxels.query(near[None])[0] == pytest.approx(STEPS.hit / STEPS.per_unit)


def test_log_odds_stay_within_the_clamps_and_few_misses_clear():
    voxels = small()
    wall, behind = ORIGIN + np.array([2.0, 0.0, 0.0]), ORIGIN + np.array([4.0, 0.0, 0.0])
    for _ in range(30):
        look(voxels, wall)
    assert voxels.query(wall[None])[0] == pytest.approx(STEPS.highest / STEPS.per_unit)
    needed = 0
    while voxels.classify(wall[None])[0] == 2:
        look(voxels, behind)
        needed += 1
    assert needed == math.floor(STEPS.highest / -STEPS.miss) + 1
    for _ in range(30):
        look(voxels, behind)
    assert voxels.query(wall[None])[0] == pytest.approx(STEPS.lowest / STEPS.per_unit)


def test_a_saturated_free_block_still_takes_a_hit():
    voxels = small()
    around = np.random.default_rng(0).normal(size=(30_000, 3))
    sphere = ORIGIN + 4.5 * around / np.linalg.norm(around, axis=1, keepdims=True)
    for _ in range(8):
        look(voxels, sphere)
    arrays = voxels.to_arrays()
    saturated = np.flatnonzero((arrays["log_odds"] == STEPS.lowest).all(axis=1))
    assert len(saturated) > 10
    target = (8 * arrays["block_xyz"][saturated[0]] + 3.5) * 0.2
    for _ in range(3):
        look(voxels, target)
    assert voxels.query(target[None])[0] == pytest.approx((STEPS.lowest + 3 * STEPS.hit) / STEPS.per_unit)
    assert voxels.classify(target[None]) == [2]


def test_rays_beyond_the_range_clear_up_to_it_and_hit_nothing():
    voxels = small()
    look(voxels, ORIGIN + np.array([50.0, 0.0, 0.0]))
    along = ORIGIN + np.array([[0.5, 0, 0], [7.5, 0, 0], [8.5, 0, 0], [50.0, 0, 0]])
    assert voxels.classify(along).tolist() == [1, 1, 0, 0]
    assert len(voxels.occupied_centers()) == 0


def test_beams_without_return_clear_up_to_their_own_range():
    voxels = small()
    ghost = ORIGIN + np.array([0.0, 3.0, 0.0])
    look(voxels, ghost)
    assert voxels.classify(ghost[None]) == [2]
    for _ in range(STEPS.hit // -STEPS.miss + 1):
        look(voxels, np.empty((0, 3)), misses=np.array([[0.0, 2.0, 0.0]], np.float32))
    assert voxels.classify(ORIGIN + np.array([[0, 3.0, 0], [0, 4.5, 0], [0, 5.5, 0]])).tolist() == [1, 1, 0]


def test_axis_parallel_rays_from_a_voxel_corner_are_straight_lines():
    voxels, start = small(), np.array([2, 1, 0])
    origin = 0.2 * start
    look(voxels, origin + 3.1 * np.concatenate([np.eye(3), -np.eye(3)]), origin=origin)
    lines = {tuple(start + k * axis) for axis in np.eye(3, dtype=int) for k in range(-16, 16)}
    assert set(known_voxels(voxels)) == {tuple(int(c) for c in cell) for cell in lines}
    assert len(voxels.occupied_centers()) == 6


def test_what_is_not_finite_or_on_the_own_body_is_dropped():
    clean, dirty = small(), small()
    ends = ORIGIN + np.random.default_rng(1).normal(size=(100, 3)) * 3 + 0.5
    bad = np.array([[np.nan, 1, 1], [np.inf, 0, 0], [0, -np.inf, np.nan], [1e30, 0, 0], *ORIGIN[None]])
    misses = np.array([[1, 0, 0], [np.nan, 0, 0], [0, 0, 0]], np.float32)
    look(clean, ends, misses=misses[:1])
    delta = look(dirty, np.concatenate([bad, ends]), misses=misses)
    assert (delta.returns, delta.misses, delta.dropped) == (100, 1, 7)
    assert known_voxels(clean) == known_voxels(dirty)
    near = ORIGIN + np.array([[0.2, 0.0, 0.0], [1.2, 0.0, 0.0]])
    assert look(small(), near, own_radius_m=0.4).returns == 1


def test_free_points_make_free_unless_hit():
    voxels = small()
    here, struck = ORIGIN + np.array([0.0, 0.0, -1.0]), ORIGIN + np.array([1.0, 0.0, 0.0])
    far_outside = ORIGIN + np.array([500.0, 0.0, 0.0])
    look(voxels, struck, free_odom=np.array([here, struck, far_outside, [np.nan, 0.0, 0.0]]))
    assert voxels.classify(np.array([here, struck, far_outside])).tolist() == [1, 2, 0]


def test_a_growing_map_keeps_what_it_has():
    """Far apart scans until the hash and the store have grown; nothing is lost or moved."""
    voxels = small()
    rng = np.random.default_rng(2)
    places = np.array([(60.0 * i - 500, 40.0 * j - 300, 5.0) for i in range(12) for j in range(10)])
    cloud = rng.normal(size=(150, 3))
    cloud *= rng.uniform(4, 7, (150, 1)) / np.linalg.norm(cloud, axis=1, keepdims=True)
    first = look(voxels, places[0] + cloud, origin=places[0])
    probe = places[0] + rng.uniform(-7, 7, (2000, 3))
    before = voxels.query(probe)
    for place in places[1:]:
        delta = look(voxels, place + cloud, origin=place)
        assert delta.returns == first.returns
    assert voxels.block_count > 10_000
    assert np.array_equal(voxels.query(probe), before, equal_nan=True)
    assert np.all(voxels.classify((places[:, None] + cloud).reshape(-1, 3)) == 2)
    assert len(np.unique(voxels.to_arrays()["block_xyz"], axis=0)) == voxels.block_count
    assert voxels.memory_bytes < 700 * voxels.block_count + 4e6  # less by what is compressed


def test_delta_names_the_blocks_that_changed():
    voxels = small()
    end = ORIGIN + np.array([3.0, 0.0, 0.0])
    first = look(voxels, end)
    assert first.blocks_met == len(first.changed_blocks) == voxels.block_count
    assert set(map(tuple, first.changed_blocks.tolist())) == {(0, -1, 0), (1, -1, 0), (2, -1, 0)}
    assert len(look(voxels, end).changed_blocks) == 0


def test_occupied_centers_are_where_the_hits_were():
    voxels = small()
    ends = ORIGIN + np.random.default_rng(4).normal(size=(200, 3)) * 2
    look(voxels, ends)
    hit = {tuple(c) for c in np.floor(ends / 0.2).astype(int).tolist()}
    assert {tuple(c) for c in np.floor(voxels.occupied_centers() / 0.2).astype(int).tolist()} == hit
    assert np.all(voxels.classify(voxels.occupied_centers()) == 2)


def test_storage_round_trip_is_exact_and_goes_on_alike(tmp_path):
    scans = list(room_scans(np.random.default_rng(9), 6, 500))
    voxels = small()
    for origin, ends in scans[:3]:
        look(voxels, ends, origin=origin)
    np.savez(tmp_path / "map.npz", **voxels.to_arrays())
    with np.load(tmp_path / "map.npz") as stored:
        again = VoxelMap.from_arrays(stored, voxels.config)
    for origin, ends in scans[3:]:
        look(voxels, ends, origin=origin)
        look(again, ends, origin=origin)
    for name, array in voxels.to_arrays().items():
        assert np.array_equal(array, again.to_arrays()[name]), name


def test_stored_maps_that_do_not_fit_are_refused():
    arrays = small().to_arrays()
    with pytest.raises(InputError, match="resolution_m"):
        VoxelMap.from_arrays(arrays, VoxelMapConfig(resolution_m=0.1))
    with pytest.raises(InputError, match="missing"):
        VoxelMap.from_arrays({"resolution_m": np.array(0.2)}, VoxelMapConfig())
    with pytest.raises(InputError, match="no map"):
        VoxelMap.from_arrays(arrays | {"log_odds": np.zeros((3, 512), np.int8)}, VoxelMapConfig())


def test_bad_poses_shapes_and_configs_are_refused():
    voxels = small()
    for origin in (np.array([np.nan, 0, 0]), np.array([1e9, 0, 0])):
        with pytest.raises(InputError, match="origin_odom"):
            voxels.insert(np.zeros((1, 3), np.float32), R_odom_body=np.eye(3), p_odom=np.zeros(3), origin_odom=origin)
    with pytest.raises(InputError, match=r"\(N, 3\)"):
        look_shape = np.zeros((4, 2), np.float32)
        voxels.insert(look_shape, R_odom_body=np.eye(3), p_odom=np.zeros(3), origin_odom=np.zeros(3))
    with pytest.raises(InputError, match="miss_clear_range_m"):
        VoxelMapConfig(max_range_m=5.0, miss_clear_range_m=6.0)
    with pytest.raises(InputError, match="max_range_m"):
        VoxelMapConfig(max_range_m=60.0, resolution_m=0.1)
    assert voxels.block_count == 0


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_nothing_of_a_scan_is_left_behind_for_the_next(seed):
    """Rays along borders, edges and corners of voxels and blocks: the scratch must be empty after each."""
    rng = np.random.default_rng(seed)
    voxels = _SHARED
    origin = 0.2 * rng.choice([0, 1, 4, 7, 8, 16], 3) * rng.choice([-1, 1], 3)
    ends = origin + 0.2 * rng.integers(-40, 41, (200, 3)) * rng.choice([0.0, 1.0, 1.0 + 1e-7], (200, 3))
    look(voxels, ends, origin=origin, misses=rng.integers(-1, 2, (50, 3)).astype(np.float32), free_odom=ends)
    assert not voxels._rays.grid.free.any()
    assert not any(bits.any() for bits in voxels._rays.grid.bits[1:])


def test_the_same_scans_give_the_same_bytes():
    def fly():
        voxels = small()
        for origin, ends in room_scans(np.random.default_rng(3), 3, 400):
            look(voxels, ends, origin=origin)
        return b"".join(a.tobytes() for a in voxels.to_arrays().values())

    assert fly() == fly()
