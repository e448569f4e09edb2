"""Trunks are found where they stand; walls, bushes, crowns and branches are none."""

import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

sys.path.insert(0, str(Path(__file__).parent))
from local_maps import CELL_M, box, cylinder, made, plane_map, with_cells

from companion.mapping.trunks import BREAST_HEIGHT_M, TrunkConfig, trunks

CONFIG, HERE = TrunkConfig(), np.array([0.0, 0.0, 1.0])


def tree(local_map, x, y, radius_m, *, top=5.0):
    return with_cells(local_map, cylinder(x, y, radius_m, -2.0, top), hides_ground=True)


@given(
    x=st.floats(-6, 6), y=st.floats(-6, 6), radius_m=st.floats(0.1, 0.45), slope=st.tuples(*[st.floats(-0.2, 0.2)] * 2)
)
@settings(max_examples=12, deadline=None)
def test_a_trunk_is_placed_within_half_a_cell(x, y, radius_m, slope):
    found = trunks(tree(plane_map(slope=slope), x, y, radius_m), HERE, CONFIG)
    assert len(found.position_odom) == 1
    at = found.position_odom[0]
    assert np.hypot(at[0] - x, at[1] - y) < 0.5 * CELL_M
    assert at[2] == pytest.approx(np.dot(slope, [x, y]) + BREAST_HEIGHT_M, abs=0.1)
    assert found.radius_m[0] == pytest.approx(radius_m, abs=0.5 * CELL_M)
    assert found.residual_m[0] < 0.5 * CELL_M


def test_a_stand_is_counted_and_moves_with_its_map():
    rng = np.random.default_rng(4)
    places = np.array([[i, j] for i in range(-6, 7, 3) for j in range(-6, 7, 3)]) + rng.uniform(-0.8, 0.8, (25, 2))
    local_map = plane_map()
    for x, y in places:
        local_map = tree(local_map, x, y, 0.15)
    found = trunks(local_map, HERE, CONFIG).position_odom
    assert len(found) == len(places)
    away = np.linalg.norm(found[:, None, :2] - places, axis=2)
    assert (away.min(axis=0) < 0.5 * CELL_M).all()
    shift = np.array([40.0, -7.0, 3.0]) * CELL_M
    moved = made(local_map.state, local_map.origin_odom + shift, local_map.ground_z_odom + shift[2])
    np.testing.assert_allclose(trunks(moved, HERE + shift, CONFIG).position_odom, found + shift, atol=1e-5)


def test_only_within_range():
    local_map = tree(tree(plane_map(), 1.0, 1.0, 0.15), 6.0, 0.0, 0.15)
    near = trunks(local_map, HERE, TrunkConfig(range_m=4.0)).position_odom
    assert near.shape == (1, 3)
    outside = trunks(local_map, np.array([500.0, 0, 0]), CONFIG)
    assert outside.position_odom.shape == (0, 3) and outside.covariance.shape == (0, 3, 3)


@pytest.mark.parametrize(
    "inside",
    [
        pytest.param(box([2, -3, -1], [2.2, 3, 4]), id="wall"),
        pytest.param(box([2, 2, -1], [2.4, 2.4, 1.1]), id="stump"),
        pytest.param(box([1, 1, 1.8], [3, 3, 5]), id="crown"),
        pytest.param(box([2, 2, 1.2], [3.5, 2.2, 1.4]), id="branch"),
        pytest.param(box([-9, -9, 3.0], [9, 9, 5]), id="roof"),
    ],
)
def test_what_is_no_trunk(inside):
    assert len(trunks(with_cells(plane_map(), inside), HERE, CONFIG).position_odom) == 0


def test_branches_do_not_move_their_trunk():
    bare = tree(plane_map(), 2.0, 2.0, 0.15)
    branched = bare
    for z, to in ((0.9, [3.2, 2.2]), (1.3, [2.2, 3.2]), (1.5, [0.8, 2.2]), (2.1, [2.2, 0.8])):
        low, high = np.minimum([2.0, 2.0], to), np.maximum([2.0, 2.0], to)
        branched = with_cells(branched, box([*low, z], [*high, z + 0.2]))
    a, b = (trunks(m, HERE, CONFIG).position_odom for m in (bare, branched))
    assert a.shape == b.shape == (1, 3)
    assert np.linalg.norm(a - b) < 0.25 * CELL_M


def test_a_trunk_without_seen_ground_around_waits():
    local_map = tree(plane_map(), 2.0, 2.0, 0.15)
    ground = local_map.ground_z_odom.copy()
    ground[40:, 40:] = np.nan
    assert len(trunks(made(local_map.state, local_map.origin_odom, ground), HERE, CONFIG).position_odom) == 0
    assert len(trunks(local_map, HERE, CONFIG).position_odom) == 1


def test_nothing_seen_gives_nothing():
    empty = made(np.zeros((80, 80, 40)), (-8, -8, -2), np.full((80, 80), np.nan))
    assert len(trunks(empty, HERE, CONFIG).position_odom) == 0
