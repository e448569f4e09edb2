"""Detours past the other side: laws on random pillars, and a trunk that a path passes on the wrong side."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.planning.detour import DRAWS, detour
from companion.planning.grid_space import GridSpace
from companion.planning.polyline import length, without_repeats
from companion.planning.tree import drop_repeats, way_length


def flat(pillars, shape=(80, 60)):
    """A plane world with discs (x, y, radius), in cells."""
    x, y = np.indices(shape) + 0.5
    blocked = np.zeros(shape, bool)
    for cx, cy, r in pillars:
        blocked |= (x - cx) ** 2 + (y - cy) ** 2 < r * r
    return GridSpace(blocked, resolution_m=1.0)


def after(space, path, *, seed, attempts=200, reach=40.0):
    room = np.zeros((64, 3))
    room[: len(path)] = path
    draws = np.random.default_rng(seed).random((attempts, DRAWS))
    draws[:, 5] = 0.5  # stay in the plane
    return room[: detour(space.steps, room, len(path), draws, reach)]


def test_a_trunk_is_passed_on_its_nearer_side():
    """A disc that reaches 2 cells below the straight line and 12 above it, and a path that goes above."""
    space = flat([(40.0, 35.0, 7.0)])
    path = np.array([[5.0, 30.0, 0.5], [33.0, 44.0, 0.5], [47.0, 44.0, 0.5], [75.0, 30.0, 0.5]])
    better = after(space, path, seed=1)
    assert space.path_free(better) and better[:, 1].max() <= 30.0
    assert length(better) < 70.5 < length(path)


@given(seed=st.integers(0, 10_000))
@settings(max_examples=60, deadline=None)
def test_every_change_keeps_the_path_free_its_ends_and_makes_it_shorter(seed):
    rng = np.random.default_rng(seed)
    space = flat(np.column_stack([rng.uniform(10, 70, 12), rng.uniform(5, 55, 12), rng.uniform(1, 4, 12)]))
    path = np.column_stack([np.linspace(1, 79, 9), rng.uniform(2, 58, 9), np.full(9, 0.5)])
    free = [n for n in range(1, 9) if space.segment_free(path[n - 1], path[n])]
    if len(free) < 2:
        return
    path = path[free[0] - 1 : next((n for n in range(free[0], 9) if n not in free), 9)]
    better = after(space, path, seed=seed)
    assert space.path_free(better) and length(better) <= length(path)
    assert (better[[0, -1]] == path[[0, -1]]).all()


@given(seed=st.integers(0, 10_000), n=st.integers(1, 20))
@settings(max_examples=100, deadline=None)
def test_lengths_and_repeats_are_those_of_numpy_to_the_bit(seed, n):
    rng = np.random.default_rng(seed)
    path = rng.uniform(0, 300, (n, 3))
    path[rng.integers(0, n, n // 2)] = path[rng.integers(0, n, n // 2)]
    assert way_length(path, n) == length(path)
    kept = path.copy()
    count = drop_repeats(kept, n)
    assert (kept[:count] == without_repeats(path)).all()


@pytest.mark.parametrize("count", [0, 1, 2])
def test_a_path_without_a_bend_is_left_alone(count):
    space = flat([])
    path = np.array([[5.0, 30.0, 0.5], [75.0, 30.0, 0.5]])[:count].reshape(-1, 3)
    assert (after(space, path, seed=0) == path).all()
