"""Whatever a scan holds, the map stays whole; and scans from different places may come in any order."""

import numpy as np
import pytest

from companion.core.errors import InputError
from companion.mapping.voxel_map import VoxelMap, VoxelMapConfig

CONFIG = VoxelMapConfig(max_range_m=8.0, miss_clear_range_m=5.0)


def insert(voxels, points, *, p=(0.0, 0.0, 0.0), R=None):
    p = np.array(p)
    return voxels.insert(points, R_odom_body=np.eye(3) if R is None else R, p_odom=p, origin_odom=p)


def random_points(seed, count=300):
    rng = np.random.default_rng(seed)
    return (rng.normal(size=(count, 3)) * rng.uniform(0.1, 4, (count, 1))).astype(np.float32)


def levels(voxels):
    """{block position: its cells}."""
    arrays = voxels.to_arrays()
    return dict(zip(map(tuple, arrays["block_xyz"].tolist()), map(bytes, arrays["log_odds"]), strict=True))


def filled():
    voxels = VoxelMap(CONFIG)
    insert(voxels, random_points(1))
    return voxels


@pytest.mark.parametrize(
    "points",
    [
        np.empty((0, 3), np.float32),
        np.full((1000, 3), np.nan, np.float32),
        np.full((1000, 3), np.inf, np.float32),
        np.full((1000, 3), -3e38, np.float32),
        np.zeros((1000, 3), np.float32),
    ],
    ids=["empty", "NaN", "inf", "squares overflow", "at the sensor"],
)
def test_scans_without_a_usable_point_change_nothing(points):
    voxels = filled()
    before = levels(voxels)
    delta = insert(voxels, points)
    assert (delta.returns, delta.dropped) == (0, len(points))
    assert levels(voxels) == before


@pytest.mark.parametrize("bad", [np.nan, np.inf, 1e6])
def test_a_pose_out_of_range_is_refused_and_changes_nothing(bad):
    voxels = filled()
    before = levels(voxels)
    for more in ({"p": (bad, 0.0, 0.0)}, {"R": np.full((3, 3), bad)}):
        with pytest.raises(InputError, match="is no pose"):
            insert(voxels, random_points(2), **more)
    assert levels(voxels) == before
    insert(voxels, random_points(3))
    again = filled()
    insert(again, random_points(3))
    assert levels(voxels) == levels(again)  # nothing of the refused scans was left behind


def test_bad_points_among_good_ones_are_as_if_not_there():
    good = random_points(4, 500)
    mixed = np.full((1500, 3), np.nan, np.float32)
    mixed[1::3] = good
    alone, among = VoxelMap(CONFIG), VoxelMap(CONFIG)
    insert(alone, good)
    insert(among, mixed)
    assert levels(alone) == levels(among)


def test_a_million_points_are_as_the_same_few_a_thousand_times():
    few = random_points(5, 1000)
    once, often = VoxelMap(CONFIG), VoxelMap(CONFIG)
    insert(once, few)
    delta = insert(often, np.tile(few, (1000, 1)))
    assert delta.returns == 1_000_000
    assert levels(once) == levels(often)


def test_scans_from_places_apart_commute():
    scans = [(random_points(seed), (40.0 * seed, 3.0, 1.0)) for seed in range(4)]
    forth, back = VoxelMap(CONFIG), VoxelMap(CONFIG)
    for points, p in scans:
        insert(forth, points, p=p)
    for points, p in reversed(scans):
        insert(back, points, p=p)
    assert levels(forth) == levels(back)


def test_scans_of_one_place_commute_while_no_cell_is_at_a_clamp():
    scans = [random_points(seed) for seed in (6, 7)]
    wide = VoxelMapConfig(max_range_m=8.0, miss_clear_range_m=5.0)
    forth, back = VoxelMap(wide), VoxelMap(wide)
    for points in scans:
        insert(forth, points)
    for points in reversed(scans):
        insert(back, points)
    assert levels(forth) == levels(back)
