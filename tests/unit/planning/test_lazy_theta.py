"""Lazy Theta*, its heap, and the flood fill of columns, against brute force."""

import heapq
import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import label

from companion.planning.grid import path_free
from companion.planning.heap import pop, push
from companion.planning.lazy_theta import COARSEST, LazyTheta
from companion.planning.polyline import length
from companion.planning.reach import Reach


@settings(max_examples=50, deadline=None)
@given(st.lists(st.one_of(st.none(), st.integers(-50, 50)), max_size=200))
def test_the_heap_gives_the_least_key(entries):
    keys, items, size, twin = np.empty(256), np.empty(256, np.int32), np.zeros(1, np.int64), []
    for item, key in enumerate(entries):
        if key is not None:
            push(keys, items, size, float(key), item)
            heapq.heappush(twin, key)
        elif twin:
            least = heapq.heappop(twin)
            assert entries[pop(keys, items, size)] == least
    assert size[0] == len(twin)


@settings(max_examples=40, deadline=None)
@given(
    seed=st.integers(0, 10_000), density=st.sampled_from([0.5, 0.65, 0.72]), height=st.sampled_from([7, 64, 70, 130])
)
def test_reach_is_the_labelling_across_faces(seed, density, height):
    rng = np.random.default_rng(seed)
    steps = (rng.random((9, 8, height)) > density).astype(np.uint8)
    free = np.argwhere(steps)
    joined, _ = label(steps)
    for _ in range(5):
        start, goal = free[rng.integers(len(free), size=2)]
        same = bool(joined[tuple(start)] == joined[tuple(goal)])
        reach = Reach(steps, start, goal)
        assert reach.joined() == same
        assert reach.joined(most_columns=3) in (None, same)


def searched(steps, ends, levels, weight=1.0, most=1e30, portion=10_000):
    search = LazyTheta()
    search.begin(steps, ends, levels=levels, weight=weight, most=most)
    while (state := search.advance(portion)) == "open":
        pass
    return state, search


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 10_000), density=st.sampled_from([0.3, 0.5, 0.65]))
def test_the_finest_lattice_finds_a_free_way_exactly_where_there_is_one(seed, density):
    rng = np.random.default_rng(seed)
    steps = (rng.random((12, 11, 8)) > density).astype(np.uint8)
    cells = np.argwhere(steps)[rng.integers(np.count_nonzero(steps), size=2)]
    ends = cells + rng.uniform(0.05, 0.95, (2, 3))
    joined, _ = label(steps)
    for levels in ((0, 0), (0, COARSEST)):
        state, search = searched(steps, ends, levels)
        assert (state == "found") == (joined[tuple(cells[0])] == joined[tuple(cells[1])])
        if state == "found":
            path = search.path()
            assert np.array_equal(path[0], ends[0]) and np.array_equal(path[-1], ends[1])
            assert path_free(steps, path)


@pytest.fixture(scope="module")
def barred():
    steps = np.ones((64, 64, 16), np.uint8)
    steps[30:33, :50] = 0
    steps[:, :, 0] = 0
    return steps, np.array([[5.3, 8.1, 8.0], [60.2, 8.7, 8.0]])


def test_the_way_around_a_wall_is_nearly_the_shortest(barred):
    steps, ends = barred
    shortest = length(np.array([ends[0], [30.0, 50.0, 8.0], [33.0, 50.0, 8.0], ends[1]]))
    for level in range(COARSEST + 1):
        state, search = searched(steps, ends, (level, COARSEST))
        assert state == "found"
        assert shortest - 1e-6 <= length(search.path()) < shortest * (1.015 if level == 0 else 1.12)


def test_portions_do_not_change_the_answer_and_memory_leaves_no_trace(barred):
    steps, ends = barred
    _, whole = searched(steps, ends, (0, 1))
    _, parts = searched(steps, ends, (0, 1), portion=7)
    assert np.array_equal(whole.path(), parts.path())
    parts.begin(steps, ends[::-1], levels=(1, 2), weight=2.0)
    parts.advance(100)
    parts.begin(steps, ends, levels=(0, 1), weight=1.0)
    assert parts.advance(1_000_000) == "found"
    assert np.array_equal(whole.path(), parts.path())


def test_no_way_is_longer_than_asked_for(barred):
    steps, ends = barred
    _, search = searched(steps, ends, (1, COARSEST))
    best = length(search.path())
    assert searched(steps, ends, (1, COARSEST), most=best * 0.999)[0] in ("exhausted", "found")
    for most in (best * 0.9, best * 1.001):
        state, again = searched(steps, ends, (1, COARSEST), most=most)
        assert state == "exhausted" or length(again.path()) < most


def test_greed_expands_less_where_it_is_easy():
    steps = np.ones((80, 80, 20), np.uint8)
    steps[40, 30:50] = 0
    ends = np.array([[5.0, 40.0, 10.0], [75.0, 40.0, 10.0]])
    counts = [searched(steps, ends, (1, 1), weight=w)[1].expanded for w in (1.0, 3.0)]
    assert counts[1] <= counts[0]
    assert all(a != b for a, b in itertools.pairwise([*counts, -1]))
