"""Boxes, rays and swept spheres of the whole map, each against brute force over single voxels."""

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.core.errors import InputError
from companion.mapping.memory import MemoryConfig
from companion.mapping.queries import box, raycast
from companion.mapping.swept import known_free
from companion.mapping.voxel_map import VoxelMap, VoxelMapConfig

CELL = 0.2
FREE, OCCUPIED, UNKNOWN = -5, 5, -128


def a_map(rng, *, occupied, unknown, absent=0.0, reach=2):
    """Random voxels in blocks -reach .. reach, some of which are not there at all."""
    voxels = VoxelMap(VoxelMapConfig(max_range_m=3.0, miss_clear_range_m=3.0))
    xyz = np.array(list(itertools.product(range(-reach, reach + 1), repeat=3)), np.int32)
    xyz = xyz[rng.random(len(xyz)) >= absent]
    chance = rng.random((len(xyz), 512))
    log_odds = np.where(chance < occupied, OCCUPIED, np.where(chance > 1 - unknown, UNKNOWN, FREE)).astype(np.int8)
    voxels.blocks.add(xyz, log_odds, voxels.steps.lowest, held=False)
    return voxels


# --- boxes


@pytest.mark.parametrize("seed", range(3))
def test_a_box_has_the_class_of_every_voxel_that_it_overlaps(seed):
    rng = np.random.default_rng(seed)
    voxels = a_map(rng, occupied=0.2, unknown=0.3, absent=0.3)
    for _ in range(10):
        low = rng.uniform(-5, 4, 3)
        high = low + rng.uniform(0.01, 3, 3)
        states, corner = box(voxels, low, high)
        assert np.all(corner <= low + 1e-9) and np.all(corner > low - CELL)
        top = corner + np.array(states.shape) * CELL
        assert np.all(top >= high - 1e-9) and np.all(top < high + CELL)
        cells = np.stack(np.indices(states.shape), axis=-1).reshape(-1, 3)
        assert np.array_equal(states.ravel(), voxels.classify(corner + (cells + 0.5) * CELL))


@pytest.mark.parametrize(
    ("low", "high", "field"),
    [
        ((0, 0, 0), (1, 0, 1), "low_odom"),
        ((0, np.nan, 0), (1, 1, 1), "low_odom"),
        ((-np.inf, 0, 0), (1, 1, 1), "low_odom"),
        ((0, 0, 0), (1, 1, np.inf), "high_odom"),
        ((0, 0, 0), (1000, 1000, 1000), "high_odom"),
    ],
)
def test_no_box_and_too_large_a_box_are_refused(low, high, field):
    with pytest.raises(InputError, match=field):
        box(a_map(np.random.default_rng(0), occupied=0.1, unknown=0.1), np.array(low), np.array(high))


# --- rays


def walk(voxels, origin, direction, range_m, stop):
    """The reference: every voxel of the ray by its crossing times, one after the other."""
    way = direction / np.linalg.norm(direction)
    p = origin / CELL
    cell = np.floor(p).astype(int)
    reach, t = range_m / CELL, 0.0
    while t <= reach:
        state = int(voxels.classify((cell + 0.5)[None] * CELL)[0])
        if state == 2 or (state == 0 and stop):
            return state, t * CELL
        with np.errstate(divide="ignore", invalid="ignore"):
            crossing = np.where(way > 0, (cell + 1 - p) / way, np.where(way < 0, (cell - p) / way, np.inf))
        axis = int(np.argmin(crossing))
        t = crossing[axis]
        cell[axis] += 1 if way[axis] > 0 else -1
    return 1, range_m


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 10_000), stop=st.booleans())
def test_rays_end_where_a_walk_over_single_voxels_ends(seed, stop):
    rng = np.random.default_rng(seed)
    voxels = a_map(rng, occupied=10 ** rng.uniform(-4, -1), unknown=0.02 * stop, absent=rng.uniform(0, 0.8))
    origins, directions = rng.uniform(-4, 4, (25, 3)), rng.normal(size=(25, 3))
    directions[:8, rng.integers(3)] = 0.0
    range_m = float(rng.uniform(0.5, 12))
    found = raycast(voxels, origins, directions, range_m, unknown="stop" if stop else "pass")
    for n in range(25):
        state, way_m = walk(voxels, origins[n], directions[n], range_m, stop)
        assert found.states[n] == state and found.hits[n] == (state == 2)
        assert found.ranges_m[n] == pytest.approx(way_m, abs=1e-9)
    lengths = np.linalg.norm(found.points_odom - origins, axis=1)
    np.testing.assert_allclose(lengths, found.ranges_m, atol=1e-9)


def test_rays_along_the_axes_and_through_corners_over_missing_blocks():
    voxels = a_map(np.random.default_rng(0), occupied=0.0, unknown=0.0, absent=1.0)
    wall = np.full((1, 512), OCCUPIED, np.int8)
    voxels.blocks.add(np.array([[5, 5, 5]], np.int32), wall, voxels.steps.lowest, held=False)
    edge = 5 * 8 * CELL
    diagonal = raycast(voxels, np.zeros((1, 3)), np.ones((1, 3)), 50.0)
    assert diagonal.hits[0]
    np.testing.assert_allclose(diagonal.points_odom[0], edge, atol=1e-9)
    for axis in range(3):
        for sign in (1, -1):
            origin = np.full((1, 3), edge + 0.7)
            origin[0, axis] = 0.0 if sign > 0 else 30.0
            along = raycast(voxels, origin, sign * np.eye(3)[[axis]], 100.0)
            assert along.hits[0]
            assert along.points_odom[0, axis] == pytest.approx(edge if sign > 0 else edge + 8 * CELL)
            assert not raycast(voxels, origin, -sign * np.eye(3)[[axis]], 100.0).hits[0]


def test_a_ray_that_begins_in_an_occupied_voxel_has_range_zero_and_the_range_ends_rays():
    voxels = a_map(np.random.default_rng(0), occupied=0.0, unknown=0.0)
    cells = voxels.blocks.log_odds[:1].copy()
    cells[0, 0] = OCCUPIED
    voxels.blocks.write(np.array([0]), cells, voxels.steps.lowest)
    corner = voxels.blocks.xyz[0] * 8 * CELL
    aside = corner + np.array([1.0, 0.1, 0.1])
    origins = np.stack([corner + 0.05, aside, aside])
    west = np.tile([-2.0, 0.0, 0.0], (3, 1))
    found = raycast(voxels, origins, west, 0.81)
    assert found.hits.tolist() == [True, True, True] and found.ranges_m.tolist() == pytest.approx([0.0, 0.8, 0.8])
    assert raycast(voxels, origins, west, 0.79).states.tolist() == [2, 1, 1]


def test_rays_that_are_none_hit_nothing_and_their_points_are_nan():
    voxels = a_map(np.random.default_rng(0), occupied=0.5, unknown=0.0)
    origins = np.zeros((6, 3))
    directions = np.ones((6, 3))
    origins[0, 0], origins[1, 1], directions[2, 2], directions[4, 0] = np.nan, 1e9, np.nan, np.inf
    directions[3] = 0.0
    found = raycast(voxels, origins, directions, 5.0)
    assert found.hits.tolist() == [False] * 5 + [True]
    assert np.isnan(found.points_odom[:5]).all() and np.isnan(found.ranges_m[:5]).all()
    assert raycast(voxels, np.empty((0, 3)), np.empty((0, 3)), 5.0).hits.shape == (0,)


@pytest.mark.parametrize(
    ("change", "field"),
    [
        ({"max_range_m": 0.0}, "max_range_m"),
        ({"max_range_m": np.nan}, "max_range_m"),
        ({"max_range_m": 1e6}, "max_range_m"),
        ({"unknown": "maybe"}, "unknown"),
        ({"directions_odom": np.zeros((3, 3))}, "directions_odom"),
    ],
)
def test_bad_ray_arguments_name_the_field(change, field):
    voxels = a_map(np.random.default_rng(0), occupied=0.1, unknown=0.1)
    good = {"origins_odom": np.zeros((2, 3)), "directions_odom": np.ones((2, 3)), "max_range_m": 5.0}
    with pytest.raises(InputError, match=field):
        raycast(voxels, **good | change)


# --- swept spheres


def gap(a, b, low, high):
    """Distance of a segment to each box (N, 3), by ternary search of a convex function."""
    first, last = np.zeros(len(low)), np.ones(len(low))

    def at(t):
        p = a + t[:, None] * (b - a)
        return np.linalg.norm(p - np.clip(p, low, high), axis=1)

    for _ in range(60):
        left, right = first + (last - first) / 3, last - (last - first) / 3
        lower = at(left) < at(right)
        first, last = np.where(lower, first, left), np.where(lower, right, last)
    return np.minimum(at((first + last) / 2), np.minimum(at(np.zeros(len(low))), at(np.ones(len(low)))))


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 10_000), radius_m=st.floats(0.02, 1.5))
def test_known_free_is_what_brute_force_over_every_voxel_near_says(seed, radius_m):
    rng = np.random.default_rng(seed)
    voxels = a_map(
        rng, occupied=10 ** rng.uniform(-5, -2), unknown=10 ** rng.uniform(-5, -2), absent=rng.choice([0, 0.1])
    )
    a, b = rng.uniform(-2.4, 2.4, (2, 20, 3))
    b[:5, rng.integers(3)] = a[:5, rng.integers(3)]
    b[5:8] = a[5:8]
    free = known_free(voxels, a, b, radius_m)
    for n in range(20):
        low, high = np.minimum(a[n], b[n]) - radius_m, np.maximum(a[n], b[n]) + radius_m
        states, corner = box(voxels, low - CELL, high + CELL)
        boxes = corner + np.argwhere(states != 1) * CELL
        nearest = gap(a[n], b[n], boxes, boxes + CELL).min() if len(boxes) else np.inf
        assert free[n] == (nearest >= radius_m) or abs(nearest - radius_m) < 1e-6


def test_a_sphere_that_just_touches_is_free_and_a_hair_more_is_not():
    voxels = a_map(np.random.default_rng(0), occupied=0.0, unknown=0.0)
    cells = np.full((1, 512), FREE, np.int8)
    cells[0, 0] = OCCUPIED  # voxel (0, 0, 0)
    voxels.blocks.write(voxels.blocks.rows_of(np.zeros((1, 3), np.int64)), cells, voxels.steps.lowest)
    a, b = np.array([[-1.0, -0.5, 0.1]]), np.array([[1.0, -0.5, 0.1]])  # passes a face at 0.5 m
    assert known_free(voxels, a, b, 0.5 - 1e-9)[0] and not known_free(voxels, a, b, 0.5 + 1e-9)[0]
    a, b = np.array([[-1.0, -0.3, -0.4]]), np.array([[1.0, -0.3, -0.4]])  # passes an edge at 0.5 m
    assert known_free(voxels, a, b, 0.5 - 1e-9)[0] and not known_free(voxels, a, b, 0.5 + 1e-9)[0]


def test_the_border_of_the_known_is_not_free():
    voxels = a_map(np.random.default_rng(0), occupied=0.0, unknown=0.0)  # blocks -2 .. 2
    border = 3 * 8 * CELL
    a = np.array([[0.0, 0.0, 0.0]])
    for axis in range(3):
        b = np.eye(3)[[axis]] * (border - 0.4)
        assert known_free(voxels, a, b, 0.399)[0] and not known_free(voxels, a, b, 0.401)[0]


def test_free_needs_free_for_every_smaller_sphere_and_every_part():
    rng = np.random.default_rng(3)
    voxels = a_map(rng, occupied=0.001, unknown=0.001)
    a, b = rng.uniform(-2, 2, (2, 400, 3))
    free = [known_free(voxels, a, b, r) for r in (0.1, 0.25, 0.4)]
    assert np.all(free[0] >= free[1]) and np.all(free[1] >= free[2]) and 50 < free[1].sum() < 350
    middle = (a + b) / 2
    halves = known_free(voxels, a, middle, 0.25) & known_free(voxels, middle, b, 0.25)
    assert np.array_equal(halves, free[1])


def test_segments_that_are_none_are_not_free():
    voxels = a_map(np.random.default_rng(0), occupied=0.0, unknown=0.0)
    a, b = np.zeros((4, 3)), np.zeros((4, 3))
    a[0, 1], b[1, 2], b[2, 0] = np.nan, np.inf, 2e5
    assert known_free(voxels, a, b, 0.3).tolist() == [False, False, False, True]
    for radius_m in (0.0, -1.0, np.nan, 1e6):
        with pytest.raises(InputError, match="radius_m"):
            known_free(voxels, a, b, radius_m)
    with pytest.raises(InputError, match="b_odom"):
        known_free(voxels, a, b[:2], 0.3)


# --- what is compressed


def test_cold_blocks_answer_as_warm_ones():
    rng = np.random.default_rng(6)
    maps = [
        VoxelMap(VoxelMapConfig(max_range_m=3.0, miss_clear_range_m=3.0, memory=MemoryConfig(keep_m=keep_m)))
        for keep_m in (0.0, 1000.0)
    ]
    for _ in range(60):
        origin = rng.uniform(-12, 12, 3) * [1, 1, 0.1]
        points = rng.normal(size=(40, 3)).astype(np.float32)
        for voxels in maps:
            voxels.insert(points, R_odom_body=np.eye(3), p_odom=origin, origin_odom=origin)
    origins, directions = rng.uniform(-12, 12, (200, 3)) * [1, 1, 0.1], rng.normal(size=(200, 3))
    a, b = origins, origins + 0.2 * directions
    for part in range(4):  # each finds cold what the last one did not bring back
        some = slice(part, None, 4)
        assert maps[0].memory.cold_blocks > 0 and maps[1].memory.cold_blocks == 0
        one, other = (raycast(v, origins[some], directions[some], 9.0, unknown="pass") for v in maps)
        assert all(np.array_equal(x, y) for x, y in zip(one, other, strict=True))
        assert np.array_equal(*(known_free(v, a[some], b[some], 0.05) for v in maps))
        for voxels in maps:
            voxels.insert(points, R_odom_body=np.eye(3), p_odom=origins[part], origin_odom=origins[part])
            for _ in range(30):  # what was asked for may go again
                voxels.memory.bring_back((np.zeros(3, np.int64), np.zeros(3, np.int64)))
                voxels.insert(points[:0], R_odom_body=np.eye(3), p_odom=origins[part], origin_odom=origins[part])
