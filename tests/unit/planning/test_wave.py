"""The wave: it reaches what faces join, its layers are a breadth-first search, its ways are free."""

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import label

from companion.planning.grid import path_free, segment_free
from companion.planning.polyline import length
from companion.planning.wave import FAR, Wave, find_free


def random_world(seed, density, shape=(12, 11, 8)):
    rng = np.random.default_rng(seed)
    steps = (rng.random(shape) > density).astype(np.uint8)
    cells = np.argwhere(steps)[rng.integers(np.count_nonzero(steps), size=2)]
    return steps, cells, cells + 0.5


@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 10_000),
    density=st.sampled_from([0.2, 0.4, 0.6]),
    shape=st.sampled_from([(12, 11, 8), (9, 70, 7), (140, 6, 5)]),
)
def test_it_reaches_what_faces_join_and_its_way_is_free(seed, density, shape):
    steps, cells, ends = random_world(seed, density, shape)
    joined, _ = label(steps)
    wave = Wave(steps, ends, block=1)
    if joined[tuple(cells[0])] != joined[tuple(cells[1])]:
        return  # an end's door may lie in another room only if that is in sight: see the next test
    assert wave.reached
    path = wave.path()
    assert np.array_equal(path[[0, -1]], ends) and path_free(steps, path)


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 10_000), density=st.sampled_from([0.3, 0.5]))
def test_a_way_that_it_gives_is_free_whatever_the_blocks(seed, density):
    steps, _, ends = random_world(seed, density, (20, 22, 16))
    for block in (1, 2, 3):
        path = Wave(steps, ends, block=block).path()
        assert len(path) == 0 or (np.array_equal(path[[0, -1]], ends) and path_free(steps, path))


def test_layers_are_those_of_a_search_layer_by_layer():
    steps, _, ends = random_world(5, 0.35, (9, 8, 70))
    wave = Wave(steps, ends, block=1)
    assert wave.reached
    last = int(wave.layers[wave.layers != FAR].max())
    front = {tuple(cell) for cell in np.argwhere(wave.layers == 0)}
    assert all(segment_free(steps, np.array(cell) + 0.5, ends[1]) for cell in front)
    along = (0, 2, 1) if abs(ends[1] - ends[0])[0] >= abs(ends[1] - ends[0])[1] else (1, 2, 0)
    seen = set(front)
    for layer in range(1, last + 1):
        front = (
            set(itertools.chain.from_iterable(neighbours(steps, cell, layer % 3 == 0, along) for cell in front)) - seen
        )
        assert front == {tuple(cell) for cell in np.argwhere(wave.layers == layer)}
        seen |= front


def neighbours(steps, cell, diagonal, along):
    """Cells one layer on: across faces, or along the axes one after the other through free cells."""

    def moved(from_, axis):
        for step in (-1, 0, 1):
            to = tuple(c + step * (n == axis) for n, c in enumerate(from_))
            if all(0 <= c < n for c, n in zip(to, steps.shape, strict=True)) and steps[to]:
                yield to

    if not diagonal:
        return [to for axis in range(3) for to in moved(cell, axis)]
    return [c for a in moved(cell, along[0]) for b in moved(a, along[1]) for c in moved(b, along[2])]


def test_layers_are_about_the_distance_in_open_space():
    steps = np.ones((61, 61, 61), np.uint8)
    middle = np.full(3, 30.5)
    wave = Wave(steps, np.stack([np.full(3, 0.5), middle]), block=1)
    reached = np.argwhere(wave.layers != FAR)
    distance = np.linalg.norm(reached + 0.5 - middle, axis=1)
    layers = wave.layers[tuple(reached.T)].astype(float)
    # In three layers at most 3 along an axis, 4 along two, 5 along three: the farthest place is (3, 1, 1), the nearest
    # border (5, 5, 5) / 3. The wave begins at all blocks around the goal.
    assert np.all(layers <= 3.0 / np.linalg.norm([5 / 3] * 3) * distance + 1.0)
    assert np.all(layers >= 3.0 / np.linalg.norm([3, 1, 1]) * (distance - np.sqrt(3.0)) - 1.0)


def test_a_way_around_a_wall_is_nearly_the_shortest():
    steps = np.ones((80, 60, 30), np.uint8)
    steps[39:41, :50] = 0
    ends = np.array([[10.5, 10.5, 15.5], [70.5, 10.5, 15.5]])
    best = 2.0 * np.hypot(28.5, 39.5) + 2.0
    for block in (1, 2):
        assert length(Wave(steps, ends, block=block).path()) < 1.06 * best


@pytest.mark.parametrize("block", [1, 2, 3])
def test_blocks_are_free_where_all_their_cells_are(block):
    steps = (np.random.default_rng(3).random((13, 12, 11)) > 0.2).astype(np.uint8)
    free = np.zeros(np.array(steps.shape) // block, np.uint8)
    find_free(steps, block, free)
    for cell in np.ndindex(free.shape):
        cube = steps[tuple(slice(n * block, (n + 1) * block) for n in cell)]
        assert free[cell] == cube.all()
