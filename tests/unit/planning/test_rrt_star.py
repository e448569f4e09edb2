"""RRT* against brute force and an exact optimum."""

import heapq
import itertools
import math

import numpy as np
import pytest

from companion.planning.polyline import length
from companion.planning.rrt_star import RRTStar, RRTStarConfig
from companion.planning.space import FieldSpace

START, GOAL = np.array([1.1, 10.1, 1.1]), np.array([18.9, 10.3, 1.1])


@pytest.fixture(scope="module")
def pillars(local_map):
    """Pillars from floor to ceiling: the optimum is planar."""
    rng = np.random.default_rng(5)
    occupied = np.zeros((100, 100, 12), bool)
    for i, j in rng.integers(12, 88, (14, 2)):
        occupied[i : i + 3, j : j + 3] = True
    occupied[40:43, 30:70] = True  # a wall across the straight way
    return FieldSpace(local_map(occupied), radius_m=0.5)


@pytest.fixture(scope="module")
def woods(local_map, forest):
    occupied = forest(
        np.random.default_rng(2), size_m=(40.0, 24.0, 7.0), stems_per_ha=600.0, keep_clear=[(2, 12), (38, 12)]
    )
    world = local_map(occupied, ground_z=0.1)
    return FieldSpace(world, radius_m=0.75, ground_z=world.ground_z_odom, agl_m=(1.0, 5.0))


def plan(space, start, goal, *, iterations, seed=0, **config):
    planner = RRTStar(RRTStarConfig(**config))
    return planner.plan(start, goal, space, rng=np.random.default_rng(seed), iterations=iterations)


def planar_optimum(space, start, goal):
    """Dijkstra over the visibility graph of the convex corners of the blocked cells in one layer."""
    blocked = space.steps[:, :, 5] == 0
    corners = [start, goal]
    for i, j in itertools.product(range(1, 100), range(1, 100)):
        window = blocked[i - 1 : i + 1, j - 1 : j + 1]
        if window.sum() == 1:
            p, q = np.argwhere(window)[0]
            away = np.array([i + (0.005 if p == 0 else -0.005), j + (0.005 if q == 0 else -0.005), 5.5])
            corners.append(space.to_odom(away))
    corners = np.array(corners)
    cost, done, queue = {0: 0.0}, set(), [(0.0, 0)]
    while queue:
        c, n = heapq.heappop(queue)
        if n == 1:
            return c
        if n in done:
            continue
        done.add(n)
        for m in range(len(corners)):
            step = float(np.linalg.norm(corners[m] - corners[n]))
            if m not in done and c + step < cost.get(m, math.inf) and space.segment_free(corners[n], corners[m]):
                cost[m] = c + step
                heapq.heappush(queue, (c + step, m))
    raise AssertionError("no way")


def assert_valid(result, space, start, goal):
    assert np.allclose(result.path[0], start) and np.allclose(result.path[-1], goal)
    assert result.cost_m == pytest.approx(length(result.path))
    for a, b in itertools.pairwise(result.path):
        points = a + np.linspace(0, 1, 3000)[:, None] * (b - a)
        assert np.all(space.steps[tuple(np.floor(space.to_cells(points)).astype(int).T)] > 0)


@pytest.mark.parametrize("first", [True, False])
@pytest.mark.parametrize("seed", range(4))
def test_paths_are_free_by_brute_force(woods, seed, first):
    start, goal = np.array([2.0, 12.0, 2.0]), np.array([38.0, 12.0, 2.0])
    result = plan(woods, start, goal, iterations=1000, seed=seed, first=first)
    assert result.solved
    assert_valid(result, woods, start, goal)


def test_cost_is_within_two_percent_of_the_visibility_optimum(pillars):
    optimum = planar_optimum(pillars, START, GOAL)
    assert optimum > 1.03 * np.linalg.norm(GOAL - START)
    for seed in range(5):
        result = plan(pillars, START, GOAL, iterations=2000, seed=seed)
        assert_valid(result, pillars, START, GOAL)
        assert optimum - 0.02 < result.cost_m < 1.02 * optimum


def test_cost_never_rises_with_iterations(woods):
    start, goal = np.array([2.0, 12.0, 2.0]), np.array([38.0, 12.0, 2.0])
    costs = [plan(woods, start, goal, iterations=n, seed=3).cost_m for n in (100, 200, 400, 800, 1600, 3200)]
    assert all(after <= before for before, after in itertools.pairwise(costs))
    assert costs[-1] < math.inf


def test_same_generator_same_path_and_memory_leaves_no_trace(pillars, woods):
    fresh = plan(pillars, START, GOAL, iterations=600, seed=7)
    planner = RRTStar(RRTStarConfig())
    planner.plan(
        np.array([2.0, 12.0, 2.0]), np.array([30.0, 12.0, 2.0]), woods, rng=np.random.default_rng(1), iterations=900
    )
    again = planner.plan(START, GOAL, pillars, rng=np.random.default_rng(7), iterations=600)
    assert np.array_equal(fresh.path, again.path)


def test_a_free_straight_line_costs_no_iterations(pillars):
    goal = START + np.array([0.0, 2.0, 0.0])
    result = plan(pillars, START, goal, iterations=1000)
    assert result.iterations == 0
    assert np.array_equal(result.path, [START, goal])


def test_a_known_path_bounds_the_cost_from_the_first_chunk(pillars):
    known = plan(pillars, START, GOAL, iterations=3000)
    planner = RRTStar(RRTStarConfig())
    result = planner.plan(
        START, GOAL, pillars, rng=np.random.default_rng(9), iterations=100, known_path=known.path[1:-1]
    )
    assert result.cost_m <= known.cost_m + 1e-9


def test_a_known_path_that_is_blocked_does_no_harm(pillars):
    through_the_wall = np.array([[5.0, 10.0, 1.1], [15.0, 10.0, 1.1]])
    planner = RRTStar(RRTStarConfig())
    rng = np.random.default_rng(0)
    result = planner.plan(START, GOAL, pillars, rng=rng, iterations=1000, known_path=through_the_wall)
    assert_valid(result, pillars, START, GOAL)


def test_an_enclosed_goal_is_not_solved_and_the_way_ends_near_it(local_map):
    occupied = np.zeros((60, 60, 10), bool)
    occupied[35:50, 20:40] = True
    occupied[38:47, 23:37] = False
    space = FieldSpace(local_map(occupied), radius_m=0.3)
    start, goal = np.array([1.0, 6.0, 1.0]), np.array([8.5, 6.0, 1.0])
    result = plan(space, start, goal, iterations=500)
    assert not result.solved and result.cost_m == math.inf and result.iterations == 500
    assert np.linalg.norm(result.path[-1] - goal) < 0.6 * np.linalg.norm(start - goal)


def test_ends_that_are_not_free_are_refused(pillars):
    inside = np.array([8.3, 10.0, 1.1])  # in the wall
    assert not plan(pillars, inside, GOAL, iterations=500).solved
    assert not plan(pillars, START, np.array([50.0, 10.0, 1.0]), iterations=500).solved
