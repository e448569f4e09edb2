"""Segments against brute force over every cell, against the true swept sphere, and the field's gradient."""

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.core.errors import InputError
from companion.mapping.distance_field import DistanceField, FieldConfig, interpolate
from companion.mapping.snapshot import gradient, inflated, segment_free
from companion.mapping.voxel_map import VoxelMap, VoxelMapConfig

CELL = 0.2
FIELD = DistanceField(FieldConfig(size_m=(4.8, 3.2, 3.2), truncation_m=1.2), resolution_m=CELL)


def random_map(rng, *, occupied=0.01, unknown=0.02):
    """A local map of random voxels around the middle of block (0, 0, 0)."""
    return FIELD.around(random_voxels(rng, occupied=occupied, unknown=unknown), np.array([0.8, 0.8, 0.8]), 0)


def random_voxels(rng, *, occupied, unknown):
    voxels = VoxelMap(VoxelMapConfig(max_range_m=3.0, miss_clear_range_m=3.0))
    xyz = np.array(list(itertools.product(range(-3, 4), repeat=3)), np.int32)
    chance = rng.random((len(xyz), 512))
    log_odds = np.where(chance < occupied, voxels.steps.highest, voxels.steps.lowest)
    log_odds = np.where(chance > 1 - unknown, -128, log_odds).astype(np.int8)
    voxels.blocks.add(xyz, log_odds, voxels.steps.lowest, held=False)
    return voxels


def random_segments(rng, local_map, number, *, reach=1.0):
    """Segments (N, 3), (N, 3) in and, with reach > 1, around the map."""
    size = np.array(local_map.state.shape) * CELL
    middle = local_map.origin_odom + size / 2
    a, b = (middle + rng.uniform(-0.5, 0.5, (number, 3)) * size * reach for _ in range(2))
    short = rng.random(number) < 0.5
    b[short] = a[short] + (b[short] - a[short]) * 0.2
    return a, b


def overlaps(local_map, a, b):
    """Part of each cell (X, Y, Z) that the segment has inside it, of its length; negative: it misses the cell."""
    p, q = ((end - local_map.origin_odom) / CELL for end in (a, b))
    first, last = np.zeros(local_map.state.shape), np.ones(local_map.state.shape)
    for axis, count in enumerate(local_map.state.shape):
        low = np.arange(count)
        way = q[axis] - p[axis]
        with np.errstate(divide="ignore", invalid="ignore"):
            t = np.stack([(low - p[axis]) / way, (low + 1 - p[axis]) / way])
        if way == 0.0:
            t = np.where((low <= p[axis]) & (p[axis] <= low + 1), [[-1.0], [2.0]], [[2.0], [-1.0]])
        shape = [1, 1, 1]
        shape[axis] = count
        first = np.maximum(first, t.min(axis=0).reshape(shape) if way else t[0].reshape(shape))
        last = np.minimum(last, t.max(axis=0).reshape(shape) if way else t[1].reshape(shape))
    return last - first


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 10_000), radius_m=st.floats(0.01, 1.1), unknown=st.sampled_from(["free", "occupied"]))
def test_free_is_what_brute_force_over_every_crossed_cell_says(seed, radius_m, unknown):
    rng = np.random.default_rng(seed)
    local_map = random_map(rng, occupied=10 ** rng.uniform(-4, -1.5), unknown=10 ** rng.uniform(-4, -1))
    blocked = inflated(local_map, radius_m, unknown=unknown)
    a, b = random_segments(rng, local_map, 40, reach=1.3)
    a[:5] = b[:5]
    free = segment_free(local_map, a, b, radius_m, unknown=unknown)
    low, high = local_map.origin_odom, local_map.origin_odom + np.array(local_map.state.shape) * CELL
    for n in range(len(a)):
        inside = np.all((a[n] >= low) & (a[n] < high) & (b[n] >= low) & (b[n] < high))
        crossed = overlaps(local_map, a[n], b[n])
        clear = not np.any(blocked & (crossed > 1e-9))
        touched = np.any(blocked & (crossed > -1e-9))
        if not inside and unknown == "occupied":
            assert not free[n]
        else:
            assert clear >= free[n] and (free[n] or touched)


def test_segments_along_the_faces_of_cells_are_free_only_if_the_cells_beside_are():
    rng = np.random.default_rng(4)
    local_map = random_map(rng, occupied=0.03, unknown=0.0)
    blocked = inflated(local_map, 0.05, unknown="free")
    shape = np.array(local_map.state.shape)
    ends = rng.integers(0, shape, (2, 600, 3))
    ends[1][:, :2] = np.where(rng.random((600, 2)) < 0.6, ends[0][:, :2], ends[1][:, :2])
    a, b = local_map.origin_odom + ends * CELL
    free = segment_free(local_map, a, b, 0.05, unknown="free")
    assert 50 < free.sum() < 550
    for n in range(len(a)):
        crossed = overlaps(local_map, a[n], b[n])
        if free[n]:
            inner = np.all(ends[0][n] != ends[1][n])  # along a face, either side will do
            assert not (inner and np.any(blocked & (crossed > 1e-6)))
        else:
            assert np.any(blocked & (crossed > -1e-6))


def test_the_law_against_the_true_swept_sphere():
    rng = np.random.default_rng(2)
    kept = missed = 0
    for _ in range(20):
        local_map = random_map(rng, occupied=0.001, unknown=0.0)
        boxes = local_map.origin_odom + np.argwhere(local_map.state == 2) * CELL
        a, b = random_segments(rng, local_map, 50)
        radius_m = rng.uniform(0.3, 0.9)
        free = segment_free(local_map, a, b, radius_m, unknown="free")
        along = a[:, None] + np.linspace(0, 1, 60)[None, :, None] * (b - a)[:, None]
        outside = along[:, :, None] - np.clip(along[:, :, None], boxes, boxes + CELL)
        nearest = np.linalg.norm(outside, axis=-1).min(axis=(1, 2)) if len(boxes) else np.full(len(a), np.inf)
        assert np.all(nearest[free] >= radius_m - 1.24 * CELL)
        sampling = np.linalg.norm(b - a, axis=1) / 118
        assert np.all(free[nearest - sampling >= radius_m + 0.87 * CELL])
        kept, missed = kept + int(free.sum()), missed + int((~free).sum())
    assert kept > 200 and missed > 200


def test_what_is_beyond_the_map_is_free_or_not_as_asked():
    local_map = random_map(np.random.default_rng(0), occupied=0.0, unknown=0.0)
    far = local_map.origin_odom + np.array([[-3.0, 1.0, 1.0], [-3.0, -1.0, 1.0], [1.0, 1.0, 1.0]])
    ends = far + np.array([[9.0, 0, 0], [9.0, 0, 0], [1.0, 1.0, 1.0]])
    assert segment_free(local_map, far, ends, 0.5, unknown="free").tolist() == [True, True, True]
    assert segment_free(local_map, far, ends, 0.5, unknown="occupied").tolist() == [False, False, True]
    corner = local_map.origin_odom + np.array(local_map.state.shape) * CELL
    assert not segment_free(local_map, corner - 0.3, corner, 0.5)
    assert segment_free(local_map, corner - 0.3, corner - 1e-6, 0.5)


def test_one_occupied_cell_on_the_way_through_blocks_what_enters_from_outside():
    voxels = random_voxels(np.random.default_rng(0), occupied=0.0, unknown=0.0)
    row = voxels.blocks.rows_of(np.zeros((1, 3), np.int64))
    cells = voxels.blocks.log_odds[row]
    cells[0, 2 * 64 + 3 * 8 + 1] = voxels.steps.highest
    voxels.blocks.write(row, cells, voxels.steps.lowest)
    local_map = FIELD.around(voxels, np.array([0.8, 0.8, 0.8]), 0)
    middle = np.array([2.5, 3.5, 1.5]) * CELL
    aside = np.array([0.5, -0.5, 0.1])
    away = np.array([[9.0, 0, 0], [0, 7.0, 0], [0, 0, -8.0], [5.0, 6.0, 7.0]])
    assert not segment_free(local_map, middle - away, middle + away, 0.1, unknown="free").any()
    assert segment_free(local_map, middle - away + aside, middle + away + aside, 0.1, unknown="free").all()


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 1e308])
@pytest.mark.parametrize("axis", range(3))
def test_what_is_not_finite_is_not_free(bad, axis):
    local_map = random_map(np.random.default_rng(0), occupied=0.0, unknown=0.0)
    a = np.tile(local_map.origin_odom + 1.0, (2, 1))
    b = a + 0.5
    a[0, axis] = b[1, axis] = bad
    assert segment_free(local_map, a, b, 0.3).tolist() == [False, False]
    assert segment_free(local_map, a, b, 0.3, unknown="free").tolist() == [False, False]
    assert np.isnan(gradient(local_map, a)).any(axis=1).tolist() == [True, False]


def test_bad_arguments_name_the_field():
    local_map = random_map(np.random.default_rng(0))
    points = np.zeros((2, 3))
    for radius_m in (0.0, -1.0, np.nan, np.inf):
        with pytest.raises(InputError, match="radius_m"):
            segment_free(local_map, points, points, radius_m)
    with pytest.raises(InputError, match="unknown"):
        inflated(local_map, 0.3, unknown="maybe")
    with pytest.raises(InputError, match="b_odom"):
        segment_free(local_map, points, np.zeros((3, 3)), 0.3)


@pytest.mark.parametrize("unknown", ["free", "occupied"])
def test_inflation_grows_with_the_radius_and_keeps_the_obstacles(unknown):
    local_map = random_map(np.random.default_rng(3))
    obstacles = local_map.state == 2 if unknown == "free" else local_map.state != 1
    layers = [inflated(local_map, r, unknown=unknown) for r in (0.05, 0.2, 0.5, 1.1)]
    assert np.array_equal(layers[0], obstacles)
    assert all(np.all(big[small]) for small, big in itertools.pairwise(layers))
    assert np.all(inflated(local_map, 1.21, unknown=unknown))  # beyond the truncation


def test_the_gradient_is_the_slope_of_the_interpolated_field():
    rng = np.random.default_rng(5)
    local_map = random_map(rng)
    size = np.array(local_map.state.shape) * CELL
    points = local_map.origin_odom + rng.uniform(-0.1, 1.1, (400, 3)) * size
    cells = (points - local_map.origin_odom) / CELL - 0.5
    points = points[np.all(np.abs(cells - np.round(cells)) > 1e-3, axis=1)]
    slope = gradient(local_map, points)
    for axis in range(3):
        step = np.eye(3)[axis] * 1e-5
        ahead, behind = (interpolate(local_map.distance_m, local_map, points + s) for s in (step, -step))
        np.testing.assert_allclose(slope[:, axis], (ahead - behind) / 2e-5, atol=1e-6)


def test_the_gradient_points_away_from_a_wall():
    local_map = random_map(np.random.default_rng(0), occupied=0.0, unknown=0.0)
    x = np.arange(local_map.state.shape[0])
    local_map.distance_m.flags.writeable = True
    local_map.distance_m[:] = np.abs(x - 8)[:, None, None] * CELL
    points = local_map.origin_odom + np.array([[6.0, 8, 8], [11.0, 4, 3]]) * CELL
    np.testing.assert_allclose(gradient(local_map, points), [[-1, 0, 0], [1, 0, 0]], atol=1e-6)
