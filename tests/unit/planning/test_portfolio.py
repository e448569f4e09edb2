"""The portfolio: free ways, falling costs, proofs that agree with a flood fill, the same answer each time."""

import itertools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import label

from companion.planning import connect, grow, lazy_theta, reach, wave
from companion.planning.config import PlanningConfig
from companion.planning.grid_space import GridSpace
from companion.planning.polyline import length
from companion.planning.portfolio import Portfolio, PortfolioConfig
from companion.planning.route import RouteConfig
from companion.planning.rrt_star import RRTStarConfig
from companion.planning.space import FieldSpace
from companion.planning.warm_up import warm_up


def plan(space, start, goal, *, iterations=300, seed=0, known_path=None, **config):
    planner = Portfolio(PortfolioConfig(**config), RRTStarConfig())
    rng = np.random.default_rng(seed)
    return planner.plan(start, goal, space, rng=rng, iterations=iterations, known_path=known_path)


def random_space(seed, density, shape=(14, 12, 9)):
    blocked = np.random.default_rng(seed).random(shape) < density
    return GridSpace(blocked, resolution_m=0.5), blocked


def two_free_places(blocked, seed):
    free = np.argwhere(~blocked)
    rng = np.random.default_rng(seed)
    cells = free[rng.integers(len(free), size=2)]
    return (cells + rng.uniform(0.05, 0.95, (2, 3))) * 0.5, cells


@pytest.fixture(scope="module")
def walled(local_map):
    """Two rooms; the wall between them has one small window."""
    occupied = np.zeros((100, 60, 30), bool)
    occupied[50:52] = True
    occupied[50:52, 45:51, 20:26] = False
    return FieldSpace(local_map(occupied), radius_m=0.4)


START, GOAL = np.array([3.0, 2.0, 1.0]), np.array([17.0, 2.0, 1.0])


@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 10_000), density=st.sampled_from([0.2, 0.4, 0.6, 0.7]))
def test_a_way_or_a_proof_and_the_flood_fill_agrees(seed, density):
    space, blocked = random_space(seed, density)
    (start, goal), cells = two_free_places(blocked, seed)
    joined, _ = label(~blocked)  # across faces
    reachable = joined[tuple(cells[0])] == joined[tuple(cells[1])]
    result = plan(space, start, goal, iterations=100, alone=100)
    assert result.solved == reachable
    assert (result.proof == "infeasible") == (not reachable)
    if result.solved:
        assert np.allclose(result.path[0], start) and np.allclose(result.path[-1], goal)
        assert result.cost_m == pytest.approx(length(result.path))
        assert_free(result.path, blocked)


def assert_free(path, blocked):
    """By points, much denser than cells."""
    for a, b in itertools.pairwise(path / 0.5):
        points = a + np.linspace(0, 1, 2000)[:, None] * (b - a)
        assert not blocked[tuple(np.floor(points).astype(int).T)].any()


def test_the_window_is_found_although_no_sample_is_likely_to_meet_it(walled):
    for seed in range(3):
        result = plan(walled, START, GOAL, iterations=100, seed=seed, alone=100)
        assert result.solved and walled.path_free(result.path)


def test_the_way_through_the_window_is_nearly_the_shortest(walled):
    through = np.array([[9.7, 9.6, 4.6], [10.7, 9.6, 4.6]])
    about = length(np.vstack([START, through, GOAL]))
    result = plan(walled, START, GOAL, iterations=2000)
    assert result.cost_m < 1.001 * about


def test_cost_never_rises_with_iterations(walled):
    costs = [plan(walled, START, GOAL, iterations=n, seed=4).cost_m for n in (100, 200, 400, 800, 1600)]
    assert all(after <= before for before, after in itertools.pairwise(costs))
    assert costs[-1] < math.inf


def test_a_sealed_room_is_proven_and_the_way_leads_towards_it(local_map):
    occupied = np.zeros((100, 60, 30), bool)
    occupied[50:52] = True
    result = plan(FieldSpace(local_map(occupied), radius_m=0.4), START, GOAL)
    assert not result.solved and result.proof == "infeasible" and result.cost_m == math.inf
    assert result.path[-1][0] > START[0]


def test_same_generator_same_path_and_memory_leaves_no_trace(walled):
    fresh = plan(walled, START, GOAL, iterations=500, seed=7)
    planner = Portfolio(PortfolioConfig(), RRTStarConfig())
    space, blocked = random_space(3, 0.2)
    (start, goal), _ = two_free_places(blocked, 3)
    planner.plan(start, goal, space, rng=np.random.default_rng(1), iterations=300)
    planner.plan(GOAL, START, walled, rng=np.random.default_rng(2), iterations=700)
    again = planner.plan(START, GOAL, walled, rng=np.random.default_rng(7), iterations=500)
    assert np.array_equal(fresh.path, again.path)


def test_a_known_path_bounds_the_cost(walled):
    known = plan(walled, START, GOAL, iterations=2000)
    result = plan(walled, START, GOAL, iterations=100, seed=9, known_path=known.path[1:-1])
    assert result.cost_m <= known.cost_m + 1e-9


def test_a_free_straight_line_is_the_optimum_and_costs_nothing(walled):
    goal = START + np.array([2.0, 3.0, 1.0])
    result = plan(walled, START, goal)
    assert result.iterations == 0 and result.proof == "optimal" and np.array_equal(result.path, [START, goal])


def test_the_warm_up_compiles_every_kernel_that_a_plan_may_need(walled, local_map):
    kernels = (lazy_theta.plant, lazy_theta.expand, reach.flood, connect.connect, grow.grow, grow.add_chain)
    kernels += (wave.find_free, wave.spread, wave.descend)
    warm_up(PlanningConfig(route=RouteConfig(planner="portfolio")), hull_radius_m=0.3)
    before = [len(kernel.signatures) for kernel in kernels]
    assert min(before) > 0
    sealed = np.zeros((100, 60, 30), bool)
    sealed[50:52] = True
    plan(walled, START, GOAL, iterations=600)
    plan(FieldSpace(local_map(sealed), radius_m=0.4), START, GOAL)
    assert [len(kernel.signatures) for kernel in kernels] == before
