"""Laws of all planners, and those of RRT and of roadmaps."""

import heapq
import itertools
import math
import zlib
from typing import get_args

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.core.errors import InputError
from companion.planning.grid_space import GridSpace
from companion.planning.lattice.planner import LatticeConfig
from companion.planning.planner import Plan, PlannerName
from companion.planning.polyline import length
from companion.planning.registry import PLANNERS, PlannerSettings, make_planner
from companion.planning.roadmap import PRM, Roadmap, RoadmapConfig, build_roadmap, star_radius_m
from companion.planning.rrt import RRT, RRTConfig, RRTConnect
from companion.planning.space import FieldSpace

START, GOAL = np.array([1.1, 10.1, 1.1]), np.array([18.9, 10.3, 1.1])


@pytest.fixture(scope="module")
def pillars(local_map):
    occupied = np.zeros((100, 100, 12), bool)
    for i, j in np.random.default_rng(5).integers(12, 88, (14, 2)):
        occupied[i : i + 3, j : j + 3] = True
    occupied[40:43, 30:70] = True  # a wall across the straight way
    return FieldSpace(local_map(occupied), radius_m=0.5)


@pytest.fixture(scope="module")
def plane():
    """A plane world with two walls and two gaps."""
    blocked = np.zeros((60, 60), bool)
    blocked[20], blocked[40] = True, True
    blocked[20, 48:52], blocked[40, 8:12] = False, False
    return GridSpace(blocked, resolution_m=0.5)


ENDS_2D = (np.array([2.1, 15.0, 0.25]), np.array([28.0, 15.2, 0.25]))


def ask(name, space, ends, *, seed=0, iterations=4000, known_path=None) -> Plan:
    planner, rng = make_planner(name, PlannerSettings()), np.random.default_rng(seed)
    return planner.plan(*ends, space, rng=rng, iterations=iterations, known_path=known_path)


def dense_free(space, path, n=2000):
    """Is no sample inside a blocked cell by more than 1e-6 cells? That much a way along a corner is rounded."""
    shifts = 1e-6 * np.array(list(itertools.product((-1, 1), repeat=3)))
    for a, b in itertools.pairwise(path):
        cells = space.to_cells(a + np.linspace(0, 1, n)[:, None] * (b - a))
        near = np.floor(cells[:, None] + shifts).astype(int)
        if not np.all(np.any(space.steps[tuple(np.moveaxis(near, 2, 0))] > 0, axis=1)):
            return False
    return True


@pytest.mark.parametrize("name", PLANNERS)
def test_every_planner_finds_a_free_way_in_space_and_in_the_plane(name, pillars, plane):
    for space, ends in ((pillars, (START, GOAL)), (plane, ENDS_2D)):
        plan = ask(name, space, ends)
        assert plan.solved, name
        assert np.array_equal(plan.path[[0, -1]], np.stack(ends))
        assert plan.cost_m == pytest.approx(length(plan.path))
        assert space.path_free(plan.path) and dense_free(space, plan.path)
        again = ask(name, space, ends)
        assert np.array_equal(plan.path, again.path) and plan.iterations == again.iterations


@pytest.mark.parametrize("name", PLANNERS)
def test_no_planner_finds_a_way_into_a_closed_room(name):
    blocked = np.zeros((30, 30, 6), bool)
    blocked[18:26, 10:20], blocked[20:24, 12:18] = True, False
    space = GridSpace(blocked, resolution_m=0.5)
    ends = np.array([1.2, 7.2, 1.2]), np.array([11.0, 7.4, 1.2])
    plan = ask(name, space, ends, iterations=300)
    assert not plan.solved and plan.cost_m == math.inf
    assert np.array_equal(plan.path[0], ends[0]) and space.path_free(plan.path)
    assert np.linalg.norm(plan.path[-1] - ends[1]) < 0.6 * np.linalg.norm(ends[0] - ends[1])


@pytest.mark.parametrize("name", PLANNERS)
def test_ends_that_are_blocked_or_outside_are_refused(name, pillars):
    for ends in ((np.array([8.3, 10.0, 1.1]), GOAL), (START, np.array([50.0, 10.0, 1.0]))):
        plan = ask(name, pillars, ends, iterations=200)
        assert not plan.solved and np.array_equal(plan.path, ends[0][None])


def test_an_unknown_name_gives_the_valid_ones():
    with pytest.raises(InputError, match=r"'dstar' is no planner \(valid: .*rrt_star, .*theta_star"):
        make_planner("dstar", PlannerSettings())


def test_the_configuration_knows_the_planners_of_the_registry():
    assert set(get_args(PlannerName)) == set(PLANNERS)


def test_a_heuristic_that_does_not_fit_is_refused_before_the_flight():
    with pytest.raises(InputError, match="manhattan with 26 neighbours may exceed"):
        make_planner("astar", PlannerSettings(lattice=LatticeConfig(heuristic="manhattan")))


@pytest.mark.parametrize("seed", range(3))
def test_the_cost_of_rrt_star_never_rises_with_iterations(plane, pillars, seed):
    for space, ends in ((plane, ENDS_2D), (pillars, (START, GOAL))):
        plans = [ask("rrt_star", space, ends, seed=seed, iterations=n) for n in (100, 300, 1000, 3000, 9000)]
        costs = [plan.cost_m for plan in plans]
        assert costs == sorted(costs, reverse=True) and costs[-1] < math.inf


# --- RRT --------------------------------------------------------------------------------------------


@settings(max_examples=15, deadline=None, derandomize=True)
@given(seed=st.integers(0, 10**6), bias=st.sampled_from([0.0, 0.05, 0.3]))
def test_edges_of_rrt_are_no_longer_than_a_step(pillars, seed, bias):
    plan = RRT(RRTConfig(step_m=2.0, goal_bias=bias)).plan(
        START, GOAL, pillars, rng=np.random.default_rng(seed), iterations=6000
    )
    assert plan.solved and dense_free(pillars, plan.path)
    assert np.linalg.norm(np.diff(plan.path, axis=0), axis=1).max() <= 2.0 + 1e-9


def test_rrt_stops_at_its_first_path(pillars):
    plans = [RRT(RRTConfig()).plan(START, GOAL, pillars, rng=np.random.default_rng(3), iterations=n) for n in
             (2000, 4000, 50000)]  # fmt: skip
    assert plans[0].solved and len({p.iterations for p in plans}) == 1 and len({p.cost_m for p in plans}) == 1


def test_goal_bias_and_two_trees_save_samples(pillars, plane):
    def median(space, ends, make, bias):
        planner = make(RRTConfig(goal_bias=bias))
        seeds = range(15)
        return np.median([
            planner.plan(*ends, space, rng=np.random.default_rng(s), iterations=20000).iterations
            for s in seeds
        ])  # fmt: skip

    assert median(pillars, (START, GOAL), RRT, 0.1) < 0.9 * median(pillars, (START, GOAL), RRT, 0.0)
    assert median(plane, ENDS_2D, RRTConnect, 0.0) < 0.7 * median(plane, ENDS_2D, RRT, 0.1)


# --- roadmaps -----------------------------------------------------------------------------------------


def roadmap_of(space, *, samples=400, star=False, seed=1, **config):
    rng = np.random.default_rng(seed)
    return build_roadmap(space, rng=rng, samples=samples, config=RoadmapConfig(**config), star=star)


def brute_shortest(roadmap, space, start, goal):
    """Dijkstra over the roadmap and the links of start and goal, by the definitions."""
    points = np.vstack([roadmap.points, start, goal])
    s, g = len(points) - 2, len(points) - 1
    edges = {n: set(roadmap.after[roadmap.first[n] : roadmap.first[n + 1]].tolist()) for n in range(len(points) - 2)}
    edges |= {s: set(), g: set()}
    for end in (s, g):
        near = np.argsort(np.linalg.norm(roadmap.points - points[end], axis=1), kind="stable")[: roadmap.links]
        for n in near.tolist():
            if space.segment_free(points[end], points[n]):
                edges[end].add(n)
                edges[n].add(end)
    costs, queue = {s: 0.0}, [(0.0, s)]
    while queue:
        cost, n = heapq.heappop(queue)
        if cost > costs[n]:
            continue
        for m in sorted(edges[n]):
            way = cost + float(np.linalg.norm(points[m] - points[n]))
            if way < costs.get(m, math.inf):
                costs[m] = way
                heapq.heappush(queue, (way, m))
    return costs.get(g, math.inf)


@pytest.mark.parametrize("star", [False, True])
@pytest.mark.parametrize("seed", range(3))
def test_a_query_is_the_shortest_way_along_the_roadmap(pillars, star, seed):
    roadmap = roadmap_of(pillars, star=star, seed=seed)
    plan = roadmap.query(START, GOAL, pillars)
    assert plan.cost_m == pytest.approx(brute_shortest(roadmap, pillars, START, GOAL), abs=1e-9)


@pytest.mark.parametrize("star", [False, True])
def test_edges_are_those_of_the_definition(pillars, star):
    roadmap = roadmap_of(pillars, samples=150, star=star, neighbours=6)
    assert np.all(pillars.free(roadmap.points)) and len(roadmap.points) == 150
    gaps = np.linalg.norm(roadmap.points[:, None] - roadmap.points, axis=2)
    np.fill_diagonal(gaps, np.inf)
    if star:
        wanted = gaps <= star_radius_m(pillars, 150, 1.1)
    else:
        near = np.argsort(gaps, axis=1)[:, :6]
        wanted = np.zeros(gaps.shape, bool)
        np.put_along_axis(wanted, near, True, axis=1)
        wanted |= wanted.T
    for a, b in itertools.combinations(range(150), 2):
        free = wanted[a, b] and pillars.segment_free(roadmap.points[a], roadmap.points[b])
        assert (b in roadmap.after[roadmap.first[a] : roadmap.first[a + 1]]) == free
        assert (a in roadmap.after[roadmap.first[b] : roadmap.first[b + 1]]) == free


def test_the_radius_of_prm_star_in_plane_and_space(plane):
    """gamma = 2 (1 + 1/d)^(1/d) (volume / unit ball)^(1/d): Karaman and Frazzoli 2011, section 3."""
    free_m2 = float((plane.steps > 0).sum()) * 0.25
    expected = 2 * math.sqrt(1.5) * math.sqrt(free_m2 / math.pi) * math.sqrt(math.log(500) / 500)
    assert star_radius_m(plane, 500, 1.0) == pytest.approx(expected)
    cube = GridSpace(np.zeros((20, 20, 20), bool), resolution_m=0.5)
    expected = 2 * (4 / 3) ** (1 / 3) * (1000 / (4 / 3 * math.pi)) ** (1 / 3) * (math.log(99) / 99) ** (1 / 3)
    assert star_radius_m(cube, 99, 1.0) == pytest.approx(expected)


def test_the_cost_of_prm_star_falls_towards_the_optimum(pillars):
    """More samples, shorter ways: medians over seeds."""
    best = ask("rrt_star", pillars, (START, GOAL), iterations=10000).cost_m
    costs = [
        np.median([roadmap_of(pillars, samples=n, star=True, seed=s).query(START, GOAL, pillars).cost_m
                   for s in range(5)]) for n in (60, 250, 1000)
    ]  # fmt: skip
    assert costs[0] > costs[1] > costs[2] > best and costs[2] < 1.05 * best


def test_bytes_and_back(pillars):
    roadmap = roadmap_of(pillars)
    data = roadmap.to_bytes()
    again = Roadmap.from_bytes(data)
    assert again.to_bytes() == data and roadmap_of(pillars).to_bytes() == data
    for name in ("points", "first", "after"):
        assert np.array_equal(getattr(again, name), getattr(roadmap, name))
    plans = [r.query(START, GOAL, pillars) for r in (roadmap, again)]
    assert np.array_equal(plans[0].path, plans[1].path)


def test_damaged_bytes_are_refused(pillars):
    data = roadmap_of(pillars, samples=12).to_bytes()
    for n in range(len(data)):
        with pytest.raises(InputError, match="roadmap"):
            Roadmap.from_bytes(data[:n])
        flipped = bytearray(data)
        flipped[n] ^= 0x41
        with pytest.raises(InputError, match="roadmap"):
            Roadmap.from_bytes(bytes(flipped))


def test_numbers_that_do_not_fit_are_refused_even_with_a_right_checksum(pillars):
    data = roadmap_of(pillars, samples=12).to_bytes()
    edge = len(data) - 8
    body = data[:edge] + (999).to_bytes(4, "little")
    with pytest.raises(InputError, match="leads to no place"):
        Roadmap.from_bytes(body + zlib.crc32(body).to_bytes(4, "little"))


def test_edges_that_the_map_has_closed_since_are_left_out(pillars, local_map):
    roadmap = roadmap_of(pillars, samples=800)
    before = roadmap.query(START, GOAL, pillars)
    occupied = np.zeros((100, 100, 12), bool)
    occupied[40:43, 10:95] = True  # the wall has grown on both sides
    changed = FieldSpace(local_map(occupied), radius_m=0.5)
    assert not changed.path_free(before.path)
    after = roadmap.query(START, GOAL, changed)
    assert after.solved and changed.path_free(after.path) and after.cost_m > before.cost_m


def test_a_known_path_gives_places_to_prm(plane):
    known = ask("astar", plane, ENDS_2D).path
    planner = PRM(RoadmapConfig())
    few = planner.plan(*ENDS_2D, plane, rng=np.random.default_rng(0), iterations=5)
    helped = planner.plan(*ENDS_2D, plane, rng=np.random.default_rng(0), iterations=5, known_path=known)
    assert not few.solved and helped.solved and helped.cost_m <= length(known) + 1e-6
