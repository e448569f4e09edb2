"""Laws of the speed profile, the known-free stop and the smoother."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.core.messages import Limits
from companion.planning.bends import curvature
from companion.planning.flown import Flown, with_speeds
from companion.planning.polyline import arc_length, length, project, resample
from companion.planning.rrt_star import RRTStar, RRTStarConfig
from companion.planning.smooth import SmoothConfig, smooth
from companion.planning.space import FieldSpace
from companion.planning.speed_profile import SpeedConfig, known_free_m, speed_profile

LIMITS = Limits(
    speed=3.0,
    climb=1.0,
    accel=3.0,
    jerk=20.0,
    yaw_rate=1.0,
    clearance=0.4,
    unknown="stop_before",
    agl_min=0.5,
    agl_max=5.0,
)
CONFIG = SpeedConfig()


def profile(points, *, start=0.0, accel_start=0.0, stop_m=np.inf, clearance=np.inf, limits=LIMITS):
    near = np.broadcast_to(clearance, len(points))
    return speed_profile(points, limits, CONFIG, clearance_m=near, start=(start, accel_start), stop_m=stop_m)


def straight(total_m=12.0):
    return resample(np.array([[0.0, 0.0, 2.0], [total_m, 0.0, 2.0]]), 0.1)


@given(start=st.floats(0, 3), stop_m=st.floats(0, 20), accel=st.floats(0.5, 6))
@settings(deadline=None, max_examples=60)
def test_a_stop_is_kept_by_the_acceleration_limit(start, stop_m, accel):
    points, limits = straight(), replace(LIMITS, accel=accel)
    speeds = profile(points, start=start, stop_m=stop_m, limits=limits)
    s, end = arc_length(points), min(stop_m, 12.0)
    if start**2 <= 2 * CONFIG.along_share * accel * end and start <= CONFIG.approach_gain_per_s * end:
        assert np.all(speeds**2 <= 2 * accel * np.maximum(end - s, 0.0) + 1e-9)
        assert np.all(speeds[s >= end] == 0.0)
    steps = np.diff(speeds**2) / (2 * np.diff(s))
    assert steps.max() <= CONFIG.along_share * accel + 1e-9 and steps.min() >= -accel - 1e-9
    assert speeds[0] == pytest.approx(start if end > 0 or start > 0 else 0.0, abs=1e-9) or speeds[0] < start


def test_it_is_as_fast_as_allowed():
    speeds = profile(straight(20.0))
    assert speeds.max() == pytest.approx(3.0) and np.count_nonzero(speeds > 2.999) > 120


def test_curves_climbs_and_obstacles_slow_down():
    turn = np.linspace(0, 2 * np.pi, 126)
    circle = np.stack([np.cos(turn), np.sin(turn), 0 * turn], axis=1) * 2.0
    assert curvature(circle)[10:-10] == pytest.approx(0.5, rel=0.02)
    assert profile(circle)[60] == pytest.approx(np.sqrt(CONFIG.lateral_share * 3.0 * 2.0), rel=0.02)
    climb = resample(np.array([[0.0, 0.0, 0.0], [6.0, 0.0, 6.0]]), 0.1)
    assert profile(climb).max() == pytest.approx(np.sqrt(2.0), rel=1e-6)
    near = profile(straight(), clearance=0.2)
    assert near.max() == pytest.approx(CONFIG.near_speed_m_s + CONFIG.near_gain_per_s * 0.1)


def test_too_fast_brakes_with_the_whole_limit_and_no_more():
    points = straight()
    speeds = profile(points, start=3.0, stop_m=0.5)
    assert np.allclose(speeds**2, np.maximum(9.0 - 2 * 3.0 * arc_length(points), 0.0))


@pytest.mark.parametrize("seed", range(12))
def test_it_can_always_stop_before_the_first_unknown(local_map, seed):
    """Random unknown blobs on the way: v^2 / (2 a) never exceeds the way to the first one."""
    rng = np.random.default_rng(seed)
    known = np.ones((100, 40, 24), bool)
    for i, j, k in rng.integers([25, 10, 4], [100, 30, 18], (3, 3)):
        known[i : i + 4, j : j + 4, k : k + 4] = False
    space = FieldSpace(local_map(np.zeros(known.shape, bool), known=known), radius_m=0.85)
    path = np.array([[1.0, 4.0, 2.0], [19.0, rng.uniform(2, 6), 2.4]])
    flown = with_speeds(
        path, space, LIMITS, CONFIG, hull_radius_m=0.35, known_radius_m=0.75, start=(0.0, 0.0), reach_m=18.0
    )
    points, speeds = flown.ahead_until_stop
    unknown = np.argwhere(~known) * 0.2 + 0.1
    gap = np.array([np.linalg.norm(unknown - p, axis=1).min() for p in flown.points])
    touching = np.flatnonzero(gap < 0.35)  # the hull would reach an unknown cell
    first_m = arc_length(flown.points)[touching[0]] if touching.size else np.inf
    s = arc_length(points)
    assert speeds[-1] == 0.0
    assert np.all(speeds**2 / (2 * LIMITS.accel) <= np.maximum(first_m - s, 0.0) + 1e-9)


def test_single_unseen_cells_do_not_stop_it_but_a_patch_does(local_map):
    known = np.ones((60, 30, 20), bool)
    points = resample(np.array([[1.0, 3.1, 2.1], [11.0, 3.1, 2.1]]), 0.1)
    known[30, 18, 10] = False  # 0.6 m beside the line
    world = local_map(np.zeros(known.shape, bool), known=known)
    assert known_free_m(points, world, CONFIG, (0.75, 0.35)) == np.inf
    known[28:33, 17:20, 8:13] = False
    world = local_map(np.zeros(known.shape, bool), known=known)
    assert 4.0 < known_free_m(points, world, CONFIG, (0.75, 0.35)) < 4.6  # the patch is 4.6 m on
    assert known_free_m(points, world, CONFIG, (0.36, 0.35)) == np.inf


def test_what_lies_behind_may_be_unknown(local_map):
    known = np.ones((60, 30, 20), bool)
    known[:10] = False
    world = local_map(np.zeros(known.shape, bool), known=known)
    points = resample(np.array([[2.05, 3.1, 2.1], [8.0, 3.1, 2.1]]), 0.1)
    assert known_free_m(points, world, CONFIG, (0.75, 0.35)) == np.inf


@pytest.fixture(scope="module")
def woods(local_map, forest):
    occupied = forest(
        np.random.default_rng(8), size_m=(30.0, 20.0, 7.0), stems_per_ha=500.0, keep_clear=[(2, 10), (28, 10)]
    )
    world = local_map(occupied, ground_z=0.1)
    return FieldSpace(world, radius_m=0.75, ground_z=world.ground_z_odom, agl_m=(1.0, 5.0))


@pytest.mark.parametrize("seed", range(8))
def test_smoothing_never_violates_clearance_and_bends_less(woods, seed):
    rng = np.random.default_rng(seed)
    ends = [woods.nearest_free(np.array([x, rng.uniform(4, 16), 2.0]), within_m=3.0) for x in (2.0, 28.0)]
    plan = RRTStar(RRTStarConfig()).plan(*ends, woods, rng=rng, iterations=600)
    assert plan.solved
    fine = smooth(plan.path, woods, SmoothConfig())
    points = resample(fine, 0.01)
    assert np.all(woods.steps[tuple(np.floor(woods.to_cells(points)).astype(int).T)] > 0)
    assert np.allclose(fine[0], ends[0]) and np.allclose(fine[-1], ends[1])
    assert length(fine) < 1.15 * plan.cost_m + 0.5
    rough = resample(plan.path, 0.1)
    assert curvature(fine).max() <= curvature(rough).max() + 1e-6


def test_the_committed_head_stays_and_is_left_without_a_kink(woods, local_map):
    empty = FieldSpace(local_map(np.zeros((80, 80, 20), bool)), radius_m=0.5)
    head = np.array([[2.0, 8.0, 2.0], [4.0, 8.0, 2.0]])
    fine = smooth(np.array([[4.0, 8.0, 2.0], [9.0, 12.0, 2.0]]), empty, SmoothConfig(), head=head)
    s, _ = project(fine, head[1])
    assert max(project(head, p)[1] for p in fine[arc_length(fine) <= s - 0.5]) < 1e-6  # rounding reaches 0.4 m back
    assert curvature(fine).max() < 1.2


def test_a_way_with_no_room_comes_back_as_it_was(local_map):
    occupied = np.ones((40, 40, 20), bool)
    occupied[:, 18:21, 9:12] = False
    occupied[18:21, 18:, 9:12] = False
    space = FieldSpace(local_map(occupied), radius_m=0.1)
    corner = np.array([[0.5, 3.9, 2.1], [3.9, 3.9, 2.1], [3.9, 7.5, 2.1]])
    fine = smooth(corner, space, SmoothConfig())
    assert space.path_free(fine)
    assert length(fine) <= length(corner) + 1e-6


@pytest.mark.parametrize(("speed", "bend_at_m", "too_much"), [(1.0, 0.5, False), (2.4, 0.5, True), (2.4, 2.5, False)])
def test_a_bend_too_near_for_the_speed_flown_is_strain_however_slow_the_plan(speed, bend_at_m, too_much):
    """Radius 0.5 m at 1.1 m/s planned: 2.4 m/s2. From 2.4 m/s, 0.5 m of braking at 3 m/s2 leave 1.7 m/s."""
    turn = np.linspace(0.0, np.pi / 2, 9)
    bend = np.stack([bend_at_m + 0.5 * np.sin(turn), 0.5 * (1.0 - np.cos(turn)), np.full(9, 2.0)], axis=1)
    points = resample(np.vstack([[[-0.5, 0.0, 2.0]], bend, [[bend_at_m + 0.5, 4.0, 2.0]]]), 0.1)
    flown = Flown(points=points, speeds=np.full(len(points), 1.1), reach_m=4.0, stop_m=np.inf)
    strain = flown.strain(3.0, np.array([0.0, 0.0, 2.0]), np.array([speed, 0.0, 0.0]))
    assert (strain > 1.0) == too_much
