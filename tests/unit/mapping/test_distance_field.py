"""The local map against brute force; its laws; its independence of the map's future."""

import numpy as np
import pytest
from scipy import ndimage

from companion.core.errors import InputError
from companion.mapping.distance_field import DistanceField, FieldConfig, interpolate
from companion.mapping.voxel_map import VoxelMap, VoxelMapConfig

CELL_M = 0.2


def map_of(states, corner_block, *, cell_m=CELL_M):
    """A map whose cells from a block corner on have the given states (X, Y, Z)."""
    config = VoxelMapConfig(max_range_m=4.0, miss_clear_range_m=4.0, resolution_m=cell_m)
    blocks = np.array(states.shape) // 8
    split = states.reshape(blocks[0], 8, blocks[1], 8, blocks[2], 8).transpose(0, 2, 4, 1, 3, 5)
    xyz = np.argwhere(np.ones(blocks)) + corner_block
    values = np.array([-128, -30, 40], np.int8)[split.reshape(-1, 512)]
    arrays = VoxelMap(config).to_arrays()
    return VoxelMap.from_arrays(arrays | {"block_xyz": xyz.astype(np.int32), "log_odds": values}, config)


def random_states(rng, shape, shares):
    return rng.choice(3, size=shape, p=shares).astype(np.uint8)


def brute_distance(chosen, *, cell_m=CELL_M, truncation_m=2.0):
    """From every cell's centre to the nearest chosen centre, less half a cell, within 0 .. truncation."""
    if not chosen.any():
        return np.full(chosen.shape, truncation_m)
    cells = ndimage.distance_transform_edt(~chosen)
    return np.clip((cells - 0.5) * cell_m, 0.0, truncation_m)


def field(size_m=(8.0, 4.8, 3.2), *, cell_m=CELL_M, **config):
    return DistanceField(FieldConfig(size_m=size_m, **config), resolution_m=cell_m)


@pytest.mark.parametrize("shares", [(0.0, 0.998, 0.002), (0.3, 0.69, 0.01), (0.9, 0.1, 0.0), (0.0, 1.0, 0.0)])
def test_distances_are_those_of_brute_force(shares):
    states = random_states(np.random.default_rng(1), (40, 24, 16), shares)
    local = field().around(map_of(states, [-2, -1, -1]), np.zeros(3), 7)
    assert np.array_equal(local.state, states)
    np.testing.assert_allclose(local.distance_m, brute_distance(states == 2), atol=1e-6)
    np.testing.assert_allclose(local.unknown_distance_m, brute_distance(states != 1), atol=1e-6)
    assert local.stamp_ns == 7
    assert local.resolution_m == CELL_M


@pytest.mark.parametrize(("cell_m", "truncation_m"), [(0.2, 2.09), (0.1, 2.0), (0.4, 1.0), (0.2, 0.2)])
def test_distances_are_exact_for_any_reach(cell_m, truncation_m):
    """Short reaches are counted in bytes, long ones in 16 bits."""
    states = random_states(np.random.default_rng(2), (48, 56, 24), (0.0, 0.9995, 0.0005))
    size_m = tuple(n * cell_m for n in states.shape)
    local = field(size_m, cell_m=cell_m, truncation_m=truncation_m).around(
        map_of(states, [-3, -3, -1], cell_m=cell_m), np.zeros(3), 0
    )
    wanted = brute_distance(states == 2, cell_m=cell_m, truncation_m=truncation_m)
    np.testing.assert_allclose(local.distance_m, wanted, atol=2e-6)


def test_against_every_pair_of_cells():
    """scipy is trusted above; here each distance is found by hand."""
    states = random_states(np.random.default_rng(3), (16, 16, 8), (0.1, 0.89, 0.01))
    local = field((3.2, 3.2, 1.6)).around(map_of(states, [-1, -1, 0]), np.zeros(3), 0)
    cells, occupied = np.argwhere(np.ones(states.shape)), np.argwhere(states == 2)
    centers = np.linalg.norm(cells[:, None] - occupied[None], axis=2).min(axis=1)
    wanted = np.clip((centers - 0.5) * CELL_M, 0, 2.0).reshape(states.shape)
    np.testing.assert_allclose(local.distance_m, wanted, atol=1e-6)


def test_the_box_is_of_whole_blocks_around_the_vehicle():
    local = field((40.0, 40.0, 10.0)).around(VoxelMap(VoxelMapConfig()), np.array([101.3, -55.5, 7.7]), 0)
    assert local.state.shape == (200, 200, 56)
    assert np.all(local.state == 0)
    assert np.all(local.distance_m == np.float32(2.0))
    assert np.all(local.unknown_distance_m == 0.0)
    assert np.all(np.isnan(local.ground_z_odom))
    offset = np.array([101.3, -55.5, 7.7]) - (local.origin_odom + 0.5 * CELL_M * np.array(local.state.shape))
    assert np.all(np.abs(offset) <= 0.8)
    np.testing.assert_allclose(local.origin_odom / 1.6, np.round(local.origin_odom / 1.6), atol=1e-9)


def test_cells_are_at_their_place():
    voxels = VoxelMap(VoxelMapConfig())
    origin, end = np.array([50.1, -20.3, 3.0]), np.array([53.37, -21.93, 2.25])
    voxels.insert((end - origin)[None].astype(np.float32), R_odom_body=np.eye(3), p_odom=origin, origin_odom=origin)
    local = field().around(voxels, origin, 0)
    cell = np.floor((end - local.origin_odom) / CELL_M).astype(int)
    assert np.argwhere(local.state == 2).tolist() == [cell.tolist()]
    assert local.distance_m[tuple(cell)] == 0.0
    assert local.distance_m[tuple(cell + np.array([3, 0, 0]))] == pytest.approx(0.5)


def ground_of(states, **config):
    local = field((3.2, 3.2, 3.2), **config).around(map_of(states, [-1, -1, -1]), np.zeros(3), 0)
    return (local.ground_z_odom - local.origin_odom[2]) / CELL_M - 0.5


def test_ground_is_the_lowest_occupied_cell_with_free_space_on_it():
    states = np.zeros((16, 16, 16), np.uint8)
    states[:, :, 3], states[:, :, 4:] = 2, 1
    states[2, 2, 4] = 2  # two cells thick: the upper one
    states[3, 3, 4:] = 0  # nothing free on it: not seen as ground
    states[4, 4, 15] = 2  # the roof of the box has nothing on it
    states[5, 5, 3] = 0  # not seen at all
    wanted = np.full((16, 16), 3.0)
    wanted[2, 2], wanted[3, 3], wanted[5, 5] = 4.0, np.nan, np.nan
    np.testing.assert_allclose(ground_of(states), wanted, atol=1e-5)


def test_trunk_tops_and_crowns_are_no_ground_but_slopes_are():
    states = np.ones((16, 16, 16), np.uint8)
    heights = 2 + np.arange(16) // 2
    for i in range(16):
        states[i, :, : heights[i]], states[i, :, heights[i]] = 0, 2
    states[6, 6, :12] = 2  # a trunk
    states[8, 8, :11], states[8, 8, 11] = 0, 2  # a crown over unseen ground
    wanted = np.tile(heights[:, None].astype(float), (1, 16))
    wanted[6, 6] = wanted[8, 8] = np.nan
    np.testing.assert_allclose(ground_of(states), wanted, atol=1e-5)
    assert ground_of(states, ground_step_m=3.0)[8, 8] == pytest.approx(11.0, abs=1e-4)


def test_a_snapshot_does_not_change_with_the_map():
    states = random_states(np.random.default_rng(5), (40, 24, 16), (0.2, 0.7, 0.1))
    voxels, builder = map_of(states, [-2, -1, -1]), field()
    first = builder.around(voxels, np.zeros(3), 0)
    arrays = (first.state, first.distance_m, first.unknown_distance_m, first.ground_z_odom)
    before = [a.tobytes() for a in arrays]
    rays = np.random.default_rng(6).normal(size=(3000, 3)).astype(np.float32)
    for _ in range(4):
        voxels.insert(rays, R_odom_body=np.eye(3), p_odom=np.zeros(3), origin_odom=np.zeros(3))
        second = builder.around(voxels, np.zeros(3), 1)
    assert [a.tobytes() for a in arrays] == before
    assert second.state.tobytes() != before[0]
    assert not any(a.flags.writeable for a in arrays)
    assert not any(np.shares_memory(a, b) for a in arrays for b in (second.distance_m, second.state))


def test_interpolation_is_exact_for_linear_fields_and_holds_beyond_the_rim():
    local = field().around(VoxelMap(VoxelMapConfig()), np.zeros(3), 0)
    shape = np.array(local.state.shape)
    centers = local.origin_odom + (np.argwhere(np.ones(shape)) + 0.5) * CELL_M
    slope = np.array([0.3, -0.2, 0.5])
    linear = (centers @ slope).reshape(shape).astype(np.float32)
    inside = np.random.default_rng(7).uniform(centers.min(axis=0), centers.max(axis=0), (500, 3))
    np.testing.assert_allclose(interpolate(linear, local, inside), inside @ slope, atol=1e-5)
    outside = np.array([[99.0, 0.0, 0.0]])
    rim = np.array([[centers[:, 0].max(), 0.0, 0.0]])
    np.testing.assert_allclose(interpolate(linear, local, outside), rim @ slope, atol=1e-5)


def test_a_truncation_out_of_reach_is_refused():
    with pytest.raises(InputError, match="truncation_m"):
        field(truncation_m=30.0)
    with pytest.raises(InputError, match="truncation_m"):
        field(truncation_m=0.05)
