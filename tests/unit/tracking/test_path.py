"""Laws of paths, of the textbook's pure pursuit, and of what every setpoint keeps."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.tracking.demand import across
from companion.tracking.follow import limited_sum
from companion.tracking.path import RegulationConfig, TrackedPath
from companion.tracking.pure_pursuit import PursuitConfig, arc_curvature, carrot_m, pure_pursuit

vectors = st.tuples(*[st.floats(-9, 9)] * 3).map(np.array)


def wave(seed, count=200, spacing_m=0.1):
    """A smooth random way in even steps, (N, 3)."""
    rng = np.random.default_rng(seed)
    turn = np.cumsum(rng.normal(0, 0.02, count)) + 0.6 * np.sin(np.linspace(0, 9, count))
    steps = spacing_m * np.column_stack([np.cos(turn), np.sin(turn), 0.1 * np.sin(2 * turn)])
    return np.vstack([np.zeros(3), np.cumsum(steps, axis=0)])


def straight(length_m=20.0):
    x = np.arange(0.0, length_m + 1e-9, 0.1)
    return np.column_stack([x, 0 * x, 0 * x])


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 99))
def test_arc_length_is_monotone_and_places_lie_on_the_path(seed):
    points = wave(seed)
    path = TrackedPath(points, np.full(len(points), 2.0), accel_limit=3.0)
    assert np.all(np.diff(path.along) > 0)
    s = np.linspace(0, path.length_m, 57)
    places = np.array([path.at(x).p for x in s])
    gaps = np.linalg.norm(np.diff(places, axis=0), axis=1)
    assert np.all(gaps <= np.diff(s) + 1e-9)  # a chord is no longer than its arc
    assert np.array_equal(path.at(-1.0).p, points[0]) and np.allclose(path.at(1e9).p, points[-1])


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 99), vectors)
def test_the_nearest_place_is_that_of_brute_force(seed, offset):
    points = wave(seed)
    path = TrackedPath(points, np.full(len(points), 2.0), accel_limit=3.0)
    p = points[70] + 0.1 * offset
    found = np.linalg.norm(path.at(path.nearest(p)).p - p)
    fine = np.array([path.at(s).p for s in np.linspace(0, path.length_m, 1001)])
    assert found <= np.linalg.norm(fine - p, axis=1).min() + 1e-9


def test_the_nearest_place_does_not_jump_to_another_lane():
    out, back = straight(15.0), straight(15.0)[::-1] + np.array([0.0, 1.0, 0.0])  # 1 m beside the way out
    points = np.vstack([out, back])
    path = TrackedPath(points, np.full(len(points), 2.0), accel_limit=3.0)
    s, found = 0.0, []
    for x in np.arange(0.0, 10.0, 0.5):
        s = path.nearest(np.array([x, min(0.08 * x, 0.7), 0.0]), window_m=(s - 1.0, s + 4.0))
        found.append(s)
    assert np.all(np.diff(found) > 0) and found[-1] < 10.0


def test_on_a_new_path_that_crosses_itself_the_way_flown_so_far_decides():
    a = np.arange(0.0, 2 * np.pi, 0.02)
    eight = np.column_stack([6 * np.sin(a), 6 * np.sin(a) * np.cos(a), 0 * a])  # crosses itself at the origin
    path = TrackedPath(eight, np.full(len(eight), 2.0), accel_limit=3.0)
    for s in (0.3, 0.5 * path.length_m + 0.3):
        here = path.at(s)
        assert path.nearest(here.p, direction=here.tangent) == pytest.approx(s, abs=1e-6)
        aside = here.p + 0.05 * np.array([-here.tangent[1], here.tangent[0], 0.0])
        assert path.nearest(aside, direction=here.tangent) == pytest.approx(s, abs=0.1)


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 99), st.floats(0.5, 20.0), st.floats(1.0, 6.0))
def test_regulated_speeds_keep_the_acceleration_limit_and_are_never_above_the_given(seed, speed, accel):
    points, config = wave(seed), RegulationConfig(ease_s=0.0)
    given_speeds = np.full(len(points), speed)
    given_speeds[-1] = 0.0
    path = TrackedPath(points, given_speeds, accel_limit=accel, regulation=config)
    assert np.all(path.speeds <= given_speeds + 1e-9)
    along = np.diff(0.5 * path.speeds**2) / np.diff(path.along)
    bend = np.array([np.linalg.norm(path.at(s).turn) for s in path.along])
    assert np.all(np.abs(along) <= config.along_share * accel + 1e-6)
    assert np.all(path.speeds**2 * bend <= config.across_share * accel + 1e-6)


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 99), st.floats(1.5, 7.0))
def test_easing_only_lowers_and_rounds_the_end_of_a_ramp(seed, top):
    points = straight(30.0)
    x = points[:, 0]
    ramps = np.minimum(top, np.sqrt(4.0 * np.minimum(x, 30.0 - x)))
    sharp = TrackedPath(points, ramps, accel_limit=3.0, regulation=RegulationConfig(ease_s=0.0)).speeds
    eased = TrackedPath(points, ramps, accel_limit=3.0, regulation=RegulationConfig(ease_s=0.4)).speeds
    assert np.all(eased <= sharp + 1e-9) and np.all(eased >= 0.75 * sharp - 1e-9)
    bends = [np.abs(np.diff(0.5 * v**2, n=2)).max() for v in (sharp, eased)]
    assert bends[1] <= 0.8 * bends[0]


# --- pure pursuit --------------------------------------------------------------------------


@given(st.floats(0.05, 3.0), st.floats(0.5, 6.0))
def test_curvature_is_twice_the_sine_over_the_distance(alpha, distance_m):
    way = distance_m * np.array([np.cos(alpha), np.sin(alpha), 0.0])
    curvature = arc_curvature(way, np.array([2.0, 0.0, 0.0]))
    assert np.linalg.norm(curvature) == pytest.approx(2 * np.sin(alpha) / distance_m, rel=1e-9)
    assert curvature[0] == pytest.approx(0.0, abs=1e-12)


@given(st.floats(1.0, 20.0), st.floats(0.1, 1.5))
def test_on_a_circle_the_arc_to_any_carrot_is_the_circle(radius_m, angle):
    carrot = radius_m * np.array([np.sin(angle), 1 - np.cos(angle), 0.0])
    curvature = arc_curvature(carrot, np.array([1.0, 0.0, 0.0]))
    assert np.allclose(curvature, [0.0, 1.0 / radius_m, 0.0], atol=1e-9)


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 99), st.floats(0.3, 3.0))
def test_the_carrot_is_the_lookahead_distance_away(seed, distance_m):
    points = wave(seed)
    path = TrackedPath(points, np.full(len(points), 2.0), accel_limit=3.0)
    s = carrot_m(path, 2.0, path.at(2.0).p, distance_m=distance_m)
    assert s > 2.0
    if s < path.length_m:
        assert np.linalg.norm(path.at(s).p - path.at(2.0).p) == pytest.approx(distance_m, abs=0.051)


def test_pursuit_flies_straight_to_the_carrot():
    path = TrackedPath(straight(), np.full(201, 2.0), accel_limit=3.0)
    p, v = np.array([3.0, 0.6, 0.0]), np.array([2.0, 0.0, 0.0])
    config = PursuitConfig(lookahead_s=0.5, least_m=0.5)
    demand = pure_pursuit(path, path.at(3.0), p, v, config)
    carrot = path.at(carrot_m(path, 3.0, p, distance_m=1.0)).p
    assert np.linalg.norm(np.cross(demand.v, carrot - p)) < 1e-9 and demand.v[1] < 0
    assert demand.a[1] == pytest.approx(4.0 * 2 * (carrot - p)[1] / np.sum((carrot - p) ** 2))


# --- vectors -------------------------------------------------------------------------------


@given(vectors, vectors, st.floats(0.1, 5.0))
def test_a_limited_sum_keeps_the_first_and_the_limit(first, second, most):
    total = limited_sum(first, second, most)
    assert np.linalg.norm(total) <= most + 1e-9
    if np.linalg.norm(first + second) <= most:
        assert np.allclose(total, first + second)
    elif np.linalg.norm(first) < most - 1e-6 and np.linalg.norm(second) > 1e-6:
        rest = total - first
        assert np.linalg.norm(np.cross(rest, second)) < 1e-6 * (1 + np.linalg.norm(second)) ** 2
        assert np.linalg.norm(total) == pytest.approx(most, rel=1e-6)


@given(vectors)
def test_across_is_orthogonal(vector):
    tangent = np.array([0.6, 0.0, 0.8])
    assert across(vector, tangent) @ tangent == pytest.approx(0.0, abs=1e-9)
