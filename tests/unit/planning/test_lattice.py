"""Graph searches against brute force; heuristics against every way there is."""

import heapq
import itertools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from companion.core.errors import InputError
from companion.planning.grid_space import GridSpace
from companion.planning.lattice.grid import Lattice
from companion.planning.lattice.heuristics import HEURISTICS, admissible
from companion.planning.lattice.moves import moves_of
from companion.planning.lattice.planner import AStar, Dijkstra, LatticeConfig, ThetaStar

MOST_AXES = {4: 1, 8: 2, 6: 1, 18: 2, 26: 3}
RNG = np.random.default_rng(0)


def brute_moves(blocked, cell, neighbours, corners):
    """Moves of one cell by their definition, written without the tables."""
    flat = neighbours in (4, 8)
    for move in itertools.product((-1, 0, 1), (-1, 0, 1), (0,) if flat else (-1, 0, 1)):
        axes = sum(map(abs, move))
        if not 0 < axes <= MOST_AXES[neighbours]:
            continue
        box = [tuple(c + s * m for c, s, m in zip(cell, side, move, strict=True)) for side in corners_of(corners)]
        if all(all(0 <= x < n for x, n in zip(c, blocked.shape, strict=True)) and not blocked[c] for c in box):
            yield tuple(c + m for c, m in zip(cell, move, strict=True)), math.sqrt(axes)


def corners_of(corners):
    return list(itertools.product((0, 1), repeat=3)) if corners == "keep" else [(1, 1, 1)]


def brute_costs(blocked, start, neighbours, corners):
    """Cheapest way from `start` to every cell."""
    costs, queue = {start: 0.0}, [(0.0, start)]
    while queue:
        cost, cell = heapq.heappop(queue)
        if cost > costs[cell]:
            continue
        for after, step in brute_moves(blocked, cell, neighbours, corners):
            if cost + step < costs.get(after, math.inf) - 1e-12:
                costs[after] = cost + step
                heapq.heappush(queue, (cost + step, after))
    return costs


SHAPES = {4: (7, 6, 1), 8: (7, 6, 1), 6: (5, 4, 4), 18: (5, 4, 4), 26: (5, 4, 4)}
RULES = list(itertools.product((4, 8, 6, 18, 26), ("keep", "cut")))


def world(data, neighbours):
    shape = SHAPES[neighbours]
    cells = data.draw(arrays(np.int8, shape, elements=st.integers(0, 9)))
    blocked = cells < data.draw(st.integers(1, 6))
    ends = [tuple(data.draw(st.integers(0, n - 1)) for n in shape) for _ in range(2)]
    for end in ends:
        blocked[end] = False
    return blocked, *ends


@pytest.mark.parametrize(("neighbours", "corners"), RULES)
@settings(max_examples=60, deadline=None, derandomize=True)
@given(data=st.data())
def test_astar_is_dijkstra_is_brute_force(data, neighbours, corners):
    blocked, start, goal = world(data, neighbours)
    expected = brute_costs(blocked, start, neighbours, corners).get(goal, math.inf)
    lattice = Lattice(blocked, neighbours=neighbours, corners=corners)
    for heuristic in HEURISTICS:
        if admissible(heuristic, neighbours):
            found = lattice.search(start, goal, heuristic=heuristic)
            assert found.cost == pytest.approx(expected, abs=1e-9), heuristic
            assert found.solved == (expected < math.inf)
            assert_walkable(found, blocked, start, neighbours, corners)


def assert_walkable(found, blocked, start, neighbours, corners):
    """Every step is a move, and the lengths of the moves add up to the cost."""
    cells = [tuple(map(int, c)) for c in found.cells]
    assert cells[0] == start
    total = 0.0
    for cell, after in itertools.pairwise(cells):
        total += dict(brute_moves(blocked, cell, neighbours, corners))[after]
    assert not found.solved or total == pytest.approx(found.cost, abs=1e-9)


@pytest.mark.parametrize("neighbours", MOST_AXES)
@pytest.mark.parametrize("heuristic", HEURISTICS)
def test_heuristics_are_consistent_or_named_inadmissible(heuristic, neighbours):
    """h falls by at most the length of each move, for all places of a goal: numerically, over every move."""
    from companion.planning.lattice.heuristics import estimate

    code, moves = HEURISTICS.index(heuristic), moves_of(neighbours, "keep")
    reach = range(-6, 7)
    gain = -math.inf
    for left in itertools.product(reach, reach, (0,) if neighbours in (4, 8) else reach):
        here = estimate(code, *map(float, map(abs, left)))
        for offset, step in zip(moves.offsets.tolist(), moves.lengths, strict=True):
            after = estimate(code, *(float(abs(a + b)) for a, b in zip(left, offset, strict=True)))
            gain = max(gain, here - after - step)
    assert (gain <= 1e-12) == admissible(heuristic, neighbours)


def test_a_better_informed_heuristic_expands_no_more():
    """On one lattice: none <= chebyshev <= euclidean <= octile as bounds, so expansions fall in that order."""
    blocked = np.random.default_rng(4).random((60, 60)) < 0.3
    blocked[2, 2] = blocked[55, 50] = False
    lattice = Lattice(blocked, neighbours=8, corners="cut")
    found = [lattice.search((2, 2), (55, 50), heuristic=h) for h in ("none", "chebyshev", "euclidean", "octile")]
    assert all(f.cost == pytest.approx(found[0].cost) for f in found)
    counts = [f.expanded for f in found]
    assert counts == sorted(counts, reverse=True) and counts[-1] < 0.5 * counts[0]


@pytest.mark.parametrize("neighbours", [4, 8, 6, 26])
def test_open_space_needs_few_of_the_moves_and_the_cost_stays_the_least(neighbours):
    """Every cell of an open grid has exactly one way in the order of `natural`: the distance of the metric."""
    shape = (9, 8, 1) if neighbours in (4, 8) else (7, 6, 5)
    lattice = Lattice(np.zeros(shape, bool), neighbours=neighbours)
    expected = brute_costs(np.zeros(shape, bool), (3, 2, 0), neighbours, "keep")
    for goal, cost in expected.items():
        assert lattice.search((3, 2, 0), goal, heuristic="none").cost == pytest.approx(cost, abs=1e-9)
    moves = moves_of(neighbours, "keep")
    follow = [int(bits).bit_count() for bits in moves.natural[:-1]]
    assert sum(follow) / len(follow) < 0.65 * len(moves.offsets) and min(follow) == 1


def test_a_weight_bounds_the_loss():
    blocked = np.random.default_rng(5).random((40, 40, 12)) < 0.25
    blocked[1, 1, 1] = blocked[38, 37, 9] = False
    lattice = Lattice(blocked, neighbours=26)
    best = lattice.search((1, 1, 1), (38, 37, 9))
    loose = lattice.search((1, 1, 1), (38, 37, 9), weight=2.0, weighted=True)
    assert best.cost <= loose.cost <= 2.0 * best.cost + 1 / 16 and loose.expanded < best.expanded


@pytest.mark.parametrize(
    ("options", "word"),
    [
        ({"heuristic": "manhattan"}, "manhattan"),
        ({"weight": 1.5}, "weighted=true"),
        ({"heuristic": "taxi"}, "chebyshev"),
        ({"weight": 9.0}, "0 to 5"),
    ],
)
def test_what_may_overestimate_is_refused(options, word):
    lattice = Lattice(np.zeros((5, 5), bool), neighbours=8)
    with pytest.raises(InputError, match=word):
        lattice.search((0, 0), (4, 4), **options)
    with pytest.raises(InputError, match="4, 8"):
        Lattice(np.zeros((5, 5), bool), neighbours=26)
    with pytest.raises(InputError, match="keep, cut"):
        Lattice(np.zeros((5, 5), bool), neighbours=8, corners="round")


def test_manhattan_with_diagonals_is_not_optimal_and_allowed_when_asked():
    blocked = np.random.default_rng(1).random((30, 30)) < 0.25
    blocked[0, 0] = blocked[29, 25] = False
    lattice = Lattice(blocked, neighbours=8)
    loose = lattice.search((0, 0), (29, 25), heuristic="manhattan", weighted=True)
    assert loose.cost > lattice.search((0, 0), (29, 25)).cost + 0.1


def test_no_way_leads_to_the_nearest_reached_cell_and_scratch_stays_clean():
    blocked = np.zeros((20, 20), bool)
    blocked[10] = True
    lattice = Lattice(blocked, neighbours=8)
    for _ in range(2):
        found = lattice.search((2, 3), (17, 9))
        assert not found.solved and tuple(found.cells[-1]) == (9, 9) and found.expanded == 200
        assert not lattice.scratch.label.any()
    assert lattice.search((2, 3), (10, 3)).expanded == 0  # into a wall
    assert lattice.search((2, 3), (2, 99)).expanded == 0  # outside
    assert lattice.search((2, 3), (2, 3)).cost == 0.0


# --- Theta* and the planners in a space ------------------------------------------------------------


def any_angle_optimum(space, start, goal):
    """Dijkstra over start, goal and the convex corners of the blocked cells of a plane space."""
    blocked = np.pad(space.steps[:, :, 0] == 0, 1, constant_values=True)
    corners = [space.to_cells(start), space.to_cells(goal)]
    for i, j in itertools.product(range(blocked.shape[0] - 1), range(blocked.shape[1] - 1)):
        window = blocked[i : i + 2, j : j + 2]
        if window.sum() == 1:
            p, q = np.argwhere(window)[0]
            corners.append(np.array([i + (1e-6 if p == 0 else -1e-6), j + (1e-6 if q == 0 else -1e-6), 0.5]))
    points = space.to_odom(np.array(corners))
    cost, done, queue = {0: 0.0}, set(), [(0.0, 0)]
    while queue:
        c, n = heapq.heappop(queue)
        if n == 1:
            return c
        if n in done:
            continue
        done.add(n)
        for m in range(len(points)):
            step = float(np.linalg.norm(points[m] - points[n]))
            if m not in done and c + step < cost.get(m, math.inf) and space.segment_free(points[n], points[m]):
                cost[m] = c + step
                heapq.heappush(queue, (c + step, m))
    return math.inf


@pytest.mark.parametrize("seed", range(12))
def test_theta_star_lies_between_astar_and_the_optimum(seed):
    blocked = np.random.default_rng(seed).random((26, 26)) < 0.25
    blocked[:2, :2] = blocked[-2:, -2:] = False
    space = GridSpace(blocked, resolution_m=0.5)
    ends = np.array([[0.25, 0.25, 0.25], [12.75, 12.75, 0.25]])
    options = {"rng": RNG, "iterations": 0}
    grid = AStar(LatticeConfig(neighbours=8)).plan(*ends, space, **options)
    free = ThetaStar(LatticeConfig(neighbours=8)).plan(*ends, space, **options)
    assert grid.solved == free.solved
    if grid.solved:
        assert any_angle_optimum(space, *ends) - 1e-4 <= free.cost_m <= grid.cost_m + 1e-9


@pytest.mark.parametrize("kind", [Dijkstra, AStar, ThetaStar])
@settings(max_examples=25, deadline=None, derandomize=True)
@given(data=st.data())
def test_planners_ways_are_free_and_begin_and_end_where_asked(data, kind):
    blocked, start, goal = world(data, 26)
    space = GridSpace(blocked, resolution_m=0.4, origin=np.array([3.0, -2.0, 1.0]))
    inside = np.array(data.draw(st.lists(st.floats(0.05, 0.95), min_size=6, max_size=6))).reshape(2, 3)
    ends = space.to_odom(np.array([start, goal]) + inside)
    plan = kind(LatticeConfig()).plan(*ends, space, rng=RNG, iterations=0)
    reachable = goal in brute_costs(blocked, start, 6, "keep")
    assert plan.solved == reachable
    assert plan.proof == ("infeasible" if not reachable else "" if kind is ThetaStar else "optimal")
    assert np.array_equal(plan.path[0], ends[0]) and space.path_free(plan.path)
    if reachable:
        assert np.array_equal(plan.path[-1], ends[1])
        assert plan.cost_m >= np.linalg.norm(ends[1] - ends[0]) - 1e-9


def test_ends_that_are_not_free_are_refused():
    blocked = np.zeros((9, 9, 3), bool)
    blocked[4, 4, 1] = True
    space, planner = GridSpace(blocked, resolution_m=1.0), AStar(LatticeConfig())
    wall, free = np.array([4.5, 4.5, 1.5]), np.array([1.5, 1.5, 1.5])
    for ends in ((wall, free), (free, wall), (free, free + 100.0)):
        assert not planner.plan(*ends, space, rng=RNG, iterations=0).solved
