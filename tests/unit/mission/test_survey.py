import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.core.fence import Fence, area_m2, contains, crossing_edges, edge_distance_m
from companion.mission.route import split
from companion.mission.survey import best_heading, lane_count, lanes, serpentine, survey_path

RECTANGLE = ((0.0, 0.0), (30.0, 0.0), (30.0, 10.0), (0.0, 10.0))
L_SHAPE = ((0.0, 0.0), (20.0, 0.0), (20.0, 8.0), (8.0, 8.0), (8.0, 20.0), (0.0, 20.0))


def star(rng, corners):
    """A simple polygon: corners in order of angle about the origin, less than half a turn apart."""
    angles = (np.arange(corners) + rng.uniform(0, 0.45, corners)) * 2 * np.pi / corners
    radii = rng.uniform(5, 20, corners)
    return tuple((float(r * math.cos(a)), float(r * math.sin(a))) for r, a in zip(radii, angles, strict=True))


def test_a_rectangle_is_flown_along_its_long_side():
    path = survey_path(RECTANGLE, spacing_m=5.0, heading_rad=None)
    expected = [[0, 2.5], [30, 2.5], [30, 7.5], [0, 7.5]]
    np.testing.assert_allclose(path, expected, atol=1e-9)


def test_each_pass_begins_at_the_end_nearest_to_the_vehicle():
    for start in [(0, 0), (30, 0), (30, 10), (0, 10)]:
        path = survey_path(RECTANGLE, spacing_m=5.0, heading_rad=None, start_xy=start)
        assert math.dist(path[0], start) == pytest.approx(2.5)


def test_consecutive_lanes_run_against_each_other():
    path = survey_path(RECTANGLE, spacing_m=2.0, heading_rad=0.0).reshape(-1, 2, 2)
    ways = path[:, 1, 0] - path[:, 0, 0]
    assert np.all(ways[1:] * ways[:-1] < 0)


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10**6), st.integers(3, 12), st.floats(0.5, 6), st.floats(-4, 4))
def test_lanes_cover_the_polygon_and_stay_inside(seed, corners, spacing, heading):
    """Every point inside has a lane within half the spacing across; total length x pitch ~ area."""
    rng = np.random.default_rng(seed)
    polygon = star(rng, corners)
    segments = lanes(polygon, spacing, heading)
    along, across = (
        np.array([math.cos(heading), math.sin(heading)]),
        np.array([-math.sin(heading), math.cos(heading)]),
    )
    lengths = (segments[:, 1] - segments[:, 0]) @ along
    assert np.all(lengths > 0)
    np.testing.assert_allclose((segments[:, 1] - segments[:, 0]) @ across, 0, atol=1e-9)
    for a, b in segments:
        middle = (a + b) / 2
        assert contains(polygon, middle) or edge_distance_m(polygon, middle) < 1e-6
    offsets = np.asarray(polygon) @ across
    low, high = offsets.min(), offsets.max()
    pitch = (high - low) / lane_count(polygon, spacing, heading)
    assert pitch <= spacing + 1e-9
    lines = np.unique(np.round(segments[:, 0] @ across, 6))
    assert lines.min() - low <= spacing / 2 + 1e-6 and high - lines.max() <= spacing / 2 + 1e-6
    fine = lanes(polygon, 0.1, heading)
    fine_pitch = (high - low) / lane_count(polygon, 0.1, heading)
    area = ((fine[:, 1] - fine[:, 0]) @ along).sum() * fine_pitch
    assert area == pytest.approx(area_m2(polygon), rel=0.02, abs=0.3)


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10**6), st.integers(3, 9), st.floats(1.0, 5))
def test_no_heading_needs_fewer_lanes_over_a_convex_polygon(seed, corners, spacing):
    angles = np.sort(np.random.default_rng(seed).uniform(0, 2 * np.pi, corners))
    polygon = tuple((20 * math.cos(a), 9 * math.sin(a)) for a in angles)  # on an ellipse: convex
    best = lane_count(polygon, spacing, best_heading(polygon, spacing))
    assert best <= min(lane_count(polygon, spacing, h) for h in np.linspace(0, math.pi, 180))


def test_a_concave_polygon_splits_lanes_and_loses_none():
    segments = lanes(L_SHAPE, 2.0, math.pi / 2)
    assert lane_count(L_SHAPE, 2.0, math.pi / 2) == 10
    path = serpentine(segments)
    assert len(path) == 2 * len(segments)
    flown = {tuple(sorted(map(tuple, np.round(p, 6)))) for p in path.reshape(-1, 2, 2)}
    assert flown == {tuple(sorted(map(tuple, np.round(s, 6)))) for s in segments}


def test_crosshatch_adds_lanes_across():
    one = survey_path(RECTANGLE, spacing_m=5.0, heading_rad=None)
    two = survey_path(RECTANGLE, spacing_m=5.0, heading_rad=None, crosshatch=True)
    np.testing.assert_array_equal(two[: len(one)], one)
    ways = np.diff(two[len(one) :].reshape(-1, 2, 2), axis=1)[:, 0]
    np.testing.assert_allclose(ways[:, 0], 0, atol=1e-9)
    assert len(ways) == 6


@given(st.integers(2, 20), st.integers(0, 10**6), st.floats(0.3, 30))
def test_split_keeps_corners_and_length_and_bounds_each_stretch(points, seed, most):
    path = np.random.default_rng(seed).uniform(-30, 30, (points, 2))
    parts = split(path, most)
    stretches = np.hypot(*np.diff(parts, axis=0).T)
    assert stretches.max() <= most + 1e-6
    assert stretches.sum() == pytest.approx(np.hypot(*np.diff(path, axis=0).T).sum())
    for corner in path:
        assert np.min(np.hypot(*(parts - corner).T)) < 1e-9


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 10**6), st.integers(3, 12))
def test_stars_are_simple_and_contain_what_a_winding_number_says(seed, corners):
    rng = np.random.default_rng(seed)
    polygon = star(rng, corners)
    assert crossing_edges(polygon) is None
    for p in rng.uniform(-20, 20, (20, 2)):
        arms = np.asarray(polygon) - p
        angle = np.arctan2(arms[:, 1], arms[:, 0])
        turns = (np.roll(angle, -1) - angle + np.pi) % (2 * np.pi) - np.pi
        assert contains(polygon, p) == (abs(turns.sum()) > np.pi)


def test_crossing_edges_are_found_and_collinear_corners_are_not():
    assert crossing_edges(((0, 0), (4, 4), (4, 0), (0, 4))) == (0, 2)
    assert crossing_edges(((0, 0), (2, 0), (4, 0), (4, 4), (0, 4))) is None


def test_depth_in_a_fence_is_the_distance_to_the_nearest_wall():
    fence = Fence(inside=((-5.0, -5.0), (5.0, -5.0), (5.0, 5.0), (-5.0, 5.0)), alt=(-1.0, 10.0))
    assert fence.depth_m(np.array([0.0, 0.0, 4.0])) == 5.0
    assert fence.depth_m(np.array([4.0, 0.0, 4.0])) == 1.0
    assert fence.depth_m(np.array([8.0, 9.0, 4.0])) == -5.0
    assert fence.depth_m(np.array([0.0, 0.0, 9.5])) == 0.5
    assert fence.depth_m(np.array([0.0, 0.0, -3.0])) == -2.0
