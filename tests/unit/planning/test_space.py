"""The distance field's answers against brute force."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from companion.planning.space import FieldSpace, fill_ground, part_around


def dense(space, a, b, n=4000):
    """Cells of a finely sampled segment."""
    points = a + np.linspace(0.0, 1.0, n)[:, None] * (b - a)
    return np.floor(space.to_cells(points)).astype(int)


@pytest.fixture(scope="module")
def world(local_map, forest):
    occupied = forest(np.random.default_rng(3), size_m=(16.0, 16.0, 6.0), stems_per_ha=500.0)
    known = np.random.default_rng(4).random(occupied.shape) < 0.9
    return local_map(occupied, known=known, origin=(-3.0, 5.0, -0.4), ground_z=-0.3)


def test_a_cell_is_blocked_by_distance_or_height(world):
    space = FieldSpace(world, radius_m=0.6, ground_z=fill_ground(world), agl_m=(1.0, 4.0))
    z = world.origin_odom[2] + (np.arange(world.state.shape[2]) + 0.5) * 0.2
    in_band = (z >= -0.3 + 1.0 - 1e-6) & (z <= -0.3 + 4.0 + 1e-6)
    expected = (world.distance_m >= 0.6 - 1e-4) & in_band
    assert np.array_equal(space.steps > 0, expected)


@pytest.mark.parametrize("radius_m", [0.25, 0.5, 0.85])
def test_segments_agree_with_dense_sampling(world, radius_m):
    space = FieldSpace(world, radius_m=radius_m, ground_z=fill_ground(world), agl_m=(0.6, 5.0))
    rng = np.random.default_rng(1)
    low, high = space.bounds
    answers = []
    for a, b in rng.uniform(low + 0.01, high - 0.01, (1000, 2, 3)):
        free = space.segment_free(a, b)
        sampled = bool(np.all(space.steps[tuple(dense(space, a, b).T)] > 0))
        assert not free or sampled  # never free where a sample is blocked
        assert free or not sampled or _grazes(space, a, b)
        answers.append(free)
    assert 0.03 < np.mean(answers) < 0.97


def test_the_part_around_a_way_answers_as_the_whole(world):
    whole, rng = FieldSpace(world, radius_m=0.3, unknown="optimistic"), np.random.default_rng(6)
    low, high = whole.bounds
    answers = []
    for a in rng.uniform(low - 1.0, high + 1.0, (300, 3)):
        way = a + np.cumsum(rng.normal(0.0, 0.5, (6, 3)), axis=0)
        part = FieldSpace(part_around(world, way), radius_m=0.3, unknown="optimistic")
        assert np.array_equal(part.free(way), whole.free(way))
        answers += [whole.segment_free(p, q) for p, q in pairwise(way)]
        assert [part.segment_free(p, q) for p, q in pairwise(way)] == answers[-5:]
    assert 0.1 < np.mean(answers) < 0.95


def _grazes(space, a, b):
    """Sampling may miss a corner that the exact traversal meets: then finer sampling finds it."""
    return bool(np.any(space.steps[tuple(dense(space, a, b, 400_000).T)] == 0))


def test_points_outside_the_map_are_unknown(world):
    outside, far = np.array([[100.0, 0.0, 1.0]]), np.array([101.0, 0.0, 1.0])
    for unknown, free in (("blocked", False), ("stop_before", True), ("optimistic", True)):
        space = FieldSpace(world, radius_m=0.3, unknown=unknown)
        assert bool(space.free(outside)[0]) is free
        assert space.segment_free(outside[0], far) is free


def test_blocked_keeps_away_from_unknown_cells(world):
    space = FieldSpace(world, radius_m=0.3, unknown="blocked")
    assert np.array_equal(space.steps > 0, world.unknown_distance_m >= 0.3 - 1e-4)


def test_distance_is_exact_at_centres_and_linear_between(world):
    space = FieldSpace(world, radius_m=0.3)
    cells = np.array([[10, 20, 9], [11, 20, 9]])
    at = space.distance(space.to_odom(cells + 0.5))
    assert np.allclose(at, world.distance_m[tuple(cells.T)], atol=1e-6)
    between = space.distance(space.to_odom(np.array([[11.0, 20.5, 9.5]])))
    assert between[0] == pytest.approx(at.mean(), abs=1e-6)


def test_nearest_free_is_nearest(world):
    space = FieldSpace(world, radius_m=0.6, ground_z=fill_ground(world), agl_m=(1.0, 4.0))
    centers = space.to_odom(np.argwhere(space.steps > 0) + 0.5)
    for point in np.random.default_rng(2).uniform(*space.bounds, (50, 3)):
        found = space.nearest_free(point, within_m=20.0)
        if not space.free(point[None])[0]:
            best = np.linalg.norm(centers - point, axis=1).min()
            assert np.linalg.norm(found - point) == pytest.approx(best, abs=1e-9)
    deep = space.to_odom(np.array([0.5, 0.5, 0.5]))
    assert space.nearest_free(deep, within_m=0.2) is None


def test_ground_is_filled_from_the_nearest_column(world, local_map):
    partly = local_map(np.zeros((30, 20, 5), bool))
    seen = np.full((30, 20), np.nan, np.float32)
    seen[3, 4], seen[25, 10] = 1.0, 2.0
    partly = replace(partly, ground_z_odom=seen)
    filled = fill_ground(partly)
    assert filled[3, 4] == 1.0 and filled[0, 0] == 1.0 and filled[29, 19] == 2.0 and not np.isnan(filled).any()
    nothing = local_map(np.zeros((4, 4, 4), bool))
    assert fill_ground(nothing) is None
    assert np.all(fill_ground(nothing, fallback_z=-1.5) == -1.5)
