"""A* against published optimal lengths: Warframe level A1 of MovingAI's voxel benchmark, 896 x 390 x 255 cells.

Two sets of queries were published, with two rules for corners (found by trying both: each set fits one rule on every
query and fails the other): `.3dscen`, 409 queries to 8 digits in single precision, moves only where the whole box of a
diagonal is free; `.problems`, 5,875 queries to 6 digits, moves wherever the cell entered is free.
"""

import itertools
import re
from pathlib import Path

import numpy as np
import pytest

from companion.planning.lattice.grid import Lattice

FOLDER = Path(__file__).parents[4] / "shared/data/planning_warframe_voxel"
SETS = {"keep": "A1.3dmap.3dscen", "cut": "A1.3dmap.problems"}
LINE = re.compile(r"\((\d+), (\d+), (\d+)\)\s+\((\d+), (\d+), (\d+)\)\s+([\d.]+)")

pytestmark = pytest.mark.skipif(not FOLDER.is_dir(), reason="the data folder planning_warframe_voxel is not there")


def queries(corners):
    """start, goal, published length."""
    for line in (FOLDER / SETS[corners]).read_text().splitlines():
        found = LINE.match(line)
        if found:
            numbers = found.groups()
            yield tuple(map(int, numbers[:3])), tuple(map(int, numbers[3:6])), numbers[6]


@pytest.fixture(scope="module")
def level():
    """One lattice per rule, on the same blocked cells."""
    with np.load(FOLDER / "A1.npz") as data:
        blocked = np.zeros(data["dims"], np.uint8)
        blocked[tuple(data["occupied_xyz"].astype(np.int64).T)] = 1
    keep = Lattice(blocked, neighbours=26, corners="keep")
    return {"keep": keep, "cut": Lattice(blocked, neighbours=26, corners="cut", scratch=keep.scratch)}


def assert_published(lattice, query):
    """Equal to the last published digit; single precision rounds at 2e-7."""
    start, goal, text = query
    published = float(text)
    found = lattice.search(start, goal)
    last_digit = 10.0 ** -len(text.partition(".")[2])
    assert abs(found.cost - published) <= 0.51 * last_digit + 4e-7 * published, (start, goal, text, found.cost)
    steps = np.abs(np.diff(found.cells, axis=0))
    assert steps.max() == 1 and np.sqrt(steps.sum(axis=1)).sum() == pytest.approx(found.cost, abs=1e-6)


def test_as_many_queries_as_were_published():
    assert {corners: len(list(queries(corners))) for corners in SETS} == {"keep": 409, "cut": 5875}


def test_200_random_queries_have_the_published_length(level):
    every = [(corners, query) for corners in SETS for query in queries(corners)]
    chosen = np.random.default_rng(0).choice(len(every), 200, replace=False)
    for n in chosen:
        corners, query = every[n]
        assert_published(level[corners], query)


@pytest.mark.slow
@pytest.mark.parametrize("corners", SETS)
@pytest.mark.parametrize("part", range(8))
def test_every_query_has_the_published_length(level, corners, part):
    for query in itertools.islice(queries(corners), part, None, 8):
        assert_published(level[corners], query)
