"""Laws of the jerk limit: kept on every sample, replanning costs nothing, little is given away, bends keep it, too."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import linprog

from companion.core.messages import Limits
from companion.planning.bends import bending, curvature, heading_rate
from companion.planning.flown import Flown, braked, commit
from companion.planning.jerk import jerk_limited
from companion.planning.polyline import resample
from companion.planning.speed_profile import SpeedConfig, speed_profile

STEP_M = 0.1
CONFIG = SpeedConfig()
LIMITS = Limits(
    speed=6.0,
    climb=2.0,
    accel=4.0,
    jerk=20.0,
    yaw_rate=1.5,
    clearance=0.4,
    unknown="stop_before",
    agl_min=0.5,
    agl_max=9,
)


def caps(rng, count, least=0.1):
    """Squared speeds in random steps, and a stop at the end that is approached gradually."""
    steps = np.repeat(rng.uniform(least, 8.0, count // 10 + 1), 10)[:count]
    return np.minimum(steps, 1.5 * STEP_M * (count - 1 - np.arange(count))) ** 2


@given(
    seed=st.integers(0, 10_000),
    count=st.integers(3, 300),
    accel=st.floats(0.5, 6),
    jerk=st.floats(1, 100),
    start=st.tuples(st.floats(0, 1), st.floats(0, 1)),
)
@settings(deadline=None, max_examples=300)
def test_acceleration_and_jerk_keep_their_limits_on_every_sample(seed, count, accel, jerk, start):
    cap = caps(np.random.default_rng(seed), count)
    begin = start[0] * np.sqrt(cap[0]), start[1] * accel
    squared, met = jerk_limited(cap, STEP_M, along=(accel, jerk), start=begin)
    accels = np.diff(squared) / (2.0 * STEP_M)
    jerks = np.sqrt(squared[1:-1]) * np.diff(accels) / STEP_M
    assert np.all(squared <= cap + 1e-12) and np.all(squared >= 0.0)
    assert np.abs(accels).max() <= accel * (1.0 + 1e-9) + 1e-9
    if begin[0] > 0.2 or begin[0] == 0.0:  # slower, braking may end at once
        assert np.abs(jerks).max(initial=0.0) <= jerk * (1.0 + 1e-6) + 1e-6
    assert not met or squared[0] == pytest.approx(begin[0] ** 2, abs=1e-9)


@pytest.mark.parametrize("seed", range(40))
def test_a_replan_under_the_same_caps_is_never_slower_than_the_plan_it_starts_on(seed):
    cap = caps(np.random.default_rng(seed), 300, least=0.5)
    old, _ = jerk_limited(cap, STEP_M, along=(3.0, 10.0), start=(0.0, 0.0))
    for k in (1, 5, 37, 100, 200):
        accel = (old[k + 1] - old[k]) / (2.0 * STEP_M)
        new, met = jerk_limited(cap[k:], STEP_M, along=(3.0, 10.0), start=(np.sqrt(old[k]), accel))
        assert met and np.all(new >= old[k:] - 1e-9)


def test_from_rest_to_rest_it_takes_as_long_as_the_textbooks_seven_phases():
    """L / V + V / A + A / J, if all three limits are reached."""
    way_m, top, accel, jerk = 40.0, 6.0, 2.1, 12.0
    cap = np.full(round(way_m / STEP_M) + 1, top**2)
    cap[-1] = 0.0
    squared, _ = jerk_limited(cap, STEP_M, along=(accel, jerk), start=(0.0, 0.0))
    last_s = 2.0 * STEP_M / np.sqrt(squared[-2])
    assert seconds(squared) + last_s == pytest.approx(way_m / top + top / accel + accel / jerk, rel=0.01)


@pytest.mark.parametrize("seed", range(8))
def test_it_gives_little_away_against_the_best_that_a_linear_programme_finds(seed):
    """The largest sum of v^2 / 2 under the same bounds; no profile is the highest everywhere."""
    accel, jerk = 3.0, 12.0
    cap = caps(np.random.default_rng(seed), 120, least=1.0)
    ours = jerk_limited(cap, STEP_M, along=(accel, jerk), start=(0.0, 0.0))[0]
    assert seconds(ours) <= 1.05 * seconds(2.0 * best_profile(0.5 * cap, accel, jerk))


def seconds(squared):
    """Until the last point but one."""
    v = np.sqrt(squared[:-1])
    return np.sum(STEP_M / (0.5 * (v[1:] + v[:-1])))


def best_profile(cap, accel, jerk):
    """The linear programme, with the same bound on second differences: by the caps with ramps."""
    count, ramps = len(cap), cap.copy()
    for k in range(1, count):
        ramps[k] = min(ramps[k], ramps[k - 1] + accel * STEP_M)
    for k in range(count - 2, -1, -1):
        ramps[k] = min(ramps[k], ramps[k + 1] + accel * STEP_M)
    reach = np.minimum(ramps, accel * STEP_M * np.arange(count))
    bends = jerk * STEP_M**2 / np.sqrt(2.0 * np.maximum(reach, 1e-3))
    first, second = np.diff(np.eye(count), axis=0), np.diff(np.eye(count), n=2, axis=0)
    rows = np.vstack([first, -first, second, -second])
    most = np.concatenate([np.full(2 * (count - 1), accel * STEP_M), bends[1:-1], bends[1:-1]])
    bounds = [(0.0, 0.0), *[(0.0, c) for c in ramps[1:]]]
    return linprog(-np.ones(count), A_ub=rows, b_ub=most, bounds=bounds).x


def bent_way():
    """Straight, a bend to the left, one to the right and up: twice differentiable."""
    s = np.linspace(0.0, 40.0, 4001)
    turn = 0.5 * np.exp(-(((s - 12.0) / 1.5) ** 2)) - 0.45 * np.exp(-(((s - 24.0) / 1.8) ** 2))
    rise = 0.35 * np.exp(-(((s - 26.0) / 3.0) ** 2))
    heading = np.cumsum(turn) * 0.01
    steps = np.stack([np.cos(heading) * np.cos(rise), np.sin(heading) * np.cos(rise), np.sin(rise)], axis=1)
    return resample(np.cumsum(0.01 * steps, axis=0), STEP_M)


def motion(points, speeds, dt_s=0.05):
    """Velocity (M, 3) of who flies these speeds, each dt_s."""
    time = np.concatenate([[0.0], np.cumsum(STEP_M / (0.5 * (speeds[1:] + speeds[:-1]) + 1e-9))])
    velocity = np.gradient(points, STEP_M, axis=0) * speeds[:, None]
    at = np.arange(0.5, time[-1] - 0.8, dt_s)
    return np.stack([np.interp(at, time, velocity[:, axis]) for axis in range(3)], axis=1)


@pytest.mark.parametrize(("accel", "jerk"), [(3.0, 20.0), (4.0, 10.0), (5.0, 40.0), (3.0, 4.0)])
def test_the_whole_jerk_vector_of_a_bent_way_keeps_the_limit(accel, jerk):
    points, limits = bent_way(), replace(LIMITS, accel=accel, jerk=jerk)
    near = np.full(len(points), np.inf)
    speeds = speed_profile(points, limits, CONFIG, clearance_m=near, start=(0.0, 0.0))
    dt_s = 0.05
    velocity = motion(points, speeds, dt_s)
    jerks = np.linalg.norm(velocity[4:] - 2.0 * velocity[2:-2] + velocity[:-4], axis=1) / (2 * dt_s) ** 2
    assert jerks.max() <= jerk * 1.02
    assert np.linalg.norm(np.diff(velocity, axis=0), axis=1).max() / dt_s <= accel
    free = speed_profile(points, replace(limits, jerk=np.inf), CONFIG, clearance_m=near, start=(0.0, 0.0))
    loose = motion(points, free, dt_s)
    assert np.linalg.norm(loose[4:] - 2.0 * loose[2:-2] + loose[:-4], axis=1).max() / (2 * dt_s) ** 2 > jerks.max()
    assert np.all(speeds <= free + 1e-6)


def test_the_nose_can_follow_the_way():
    points = bent_way()
    limits = replace(LIMITS, yaw_rate=0.4, jerk=np.inf)
    speeds = speed_profile(points, limits, CONFIG, clearance_m=np.full(len(points), np.inf), start=(0.0, 0.0))
    assert np.max(speeds * heading_rate(points)) <= 0.4 + 1e-9
    free = replace(limits, yaw_rate=np.inf)
    faster = speed_profile(points, free, CONFIG, clearance_m=np.full(len(points), np.inf), start=(0.0, 0.0))
    assert np.max(faster * heading_rate(points)) > 0.8


def test_derivatives_of_a_helix():
    """Radius r = 2 m, c = 0.5 m up per radian, q = r^2 + c^2: bend r / q, |r'''| = r / q^1.5, heading 1 / sqrt(q)."""
    square = 2.0**2 + 0.5**2
    turn = np.arange(120) * STEP_M / np.sqrt(square)
    helix = np.stack([2.0 * np.cos(turn), 2.0 * np.sin(turn), 0.5 * turn], axis=1)
    assert curvature(helix)[6:-6] == pytest.approx(2.0 / square, rel=0.01)
    assert bending(helix)[6:-6] == pytest.approx(2.0 / square**1.5, rel=0.01)
    assert heading_rate(helix)[6:-6] == pytest.approx(1.0 / np.sqrt(square), rel=0.01)


def test_a_stop_seen_late_takes_more_jerk_and_one_seen_too_late_the_whole_acceleration():
    points = resample(np.array([[0.0, 0.0, 2.0], [20.0, 0.0, 2.0]]), STEP_M)
    near = np.full(len(points), np.inf)

    def stopped(stop_m):
        return speed_profile(points, LIMITS, CONFIG, clearance_m=near, start=(4.0, 0.0), stop_m=stop_m)

    braking = 4.0**2 / (2.0 * CONFIG.along_share * LIMITS.accel)
    first = {m: (stopped(m)[0] ** 2 - stopped(m)[1] ** 2) / (2.0 * STEP_M) for m in (9.0, braking + 1.2, 2.1)}
    assert first[9.0] == pytest.approx(0.0, abs=1e-9)
    assert 0.0 <= first[braking + 1.2] <= CONFIG.along_share * LIMITS.accel + 1e-9
    assert first[2.1] == pytest.approx(LIMITS.accel)
    assert np.all(stopped(braking + 1.2)[np.arange(len(points)) * STEP_M >= braking + 1.2] == 0.0)


def test_a_commitment_carries_speed_and_acceleration_of_the_plan():
    points = resample(np.array([[0.0, 0.0, 2.0], [20.0, 0.0, 2.0]]), STEP_M)
    speeds = speed_profile(points, LIMITS, CONFIG, clearance_m=np.full(len(points), np.inf), start=(0.0, 0.0))
    flown = Flown(points=points, speeds=speeds, reach_m=20.0, stop_m=np.inf)
    here = np.array([2.0, 0.0, 2.0])
    kept = commit(flown, here, np.array([flown.speed_at(2.0), 0.0, 0.0]), time_s=0.15)
    assert kept.start[0] == pytest.approx(flown.speed_at(1.5))
    assert kept.start[1] == pytest.approx(CONFIG.along_share * LIMITS.accel, rel=0.05)


def test_gusts_do_not_move_the_place_where_a_vehicle_stands_on_its_way():
    points = resample(np.array([[0.0, 0.0, 2.0], [20.0, 0.0, 2.0]]), STEP_M)
    flown = Flown(points=points, speeds=np.full(len(points), 0.5), reach_m=20.0, stop_m=np.inf)
    p, v = np.array([5.0, 0.0, 2.0]), np.array([0.6, 0.0, 0.0])
    flown = braked(flown, p, v, LIMITS, CONFIG, stop_m=-np.inf)
    place = flown.ahead_until_stop[0][-1].copy()
    for push_m in (0.02, 0.05, 0.08, 0.1) * 10:
        blown = place + np.array([push_m, 0.0, 0.0])
        flown = braked(flown, blown, np.array([0.35, 0.0, 0.0]), LIMITS, CONFIG, stop_m=-np.inf)
        assert np.linalg.norm(flown.ahead_until_stop[0][-1] - place) <= 2.0 * STEP_M + 1e-9


def test_replanning_ten_times_a_second_does_not_slow_a_dash_down(flights, local_map):
    """Ramps that began anew at each plan would: a 24 m dash took half as long again."""
    occupied = np.zeros((160, 60, 24), bool)
    occupied[:, :, 0] = True
    flight = flights.Flight(local_map, occupied, [3.0, 6.0, 2.0], gust=0.0, known=np.ones(occupied.shape, bool))
    flight.run(0.1)
    flight.send(flights.goal_at([27.0, 6.0, 2.0]))
    begun_s = flight.now_ns * 1e-9
    assert flight.run(30.0, until=lambda f: f.status.state == "reached")
    points = resample(np.array([[0.0, 0.0, 2.0], [24.0, 0.0, 2.0]]), STEP_M)
    plan = speed_profile(points, flights.LIMITS, CONFIG, clearance_m=np.full(len(points), np.inf), start=(0.0, 0.0))
    within = len(plan) - 3  # reached within 0.3 m
    assert flight.now_ns * 1e-9 - begun_s < 1.05 * seconds(plan[:within] ** 2) + 0.5
