"""What moves is blocked where it will be."""

import numpy as np
import pytest

from companion.core.messages import Limits, ObstacleTracks
from companion.planning.flown import with_speeds
from companion.planning.moving import MovingConfig, is_crossed, with_moving
from companion.planning.space import FieldSpace
from companion.planning.speed_profile import SpeedConfig

SECOND = 1_000_000_000
CONFIG = MovingConfig(horizon_s=1.5, margin_m=0.2, half_height_m=1.5)


def tracks(p, v, *, radius_m=0.3, stamp_ns=0):
    p, v = np.atleast_2d(np.array(p, float)), np.atleast_2d(np.array(v, float))
    n = len(p)
    return ObstacleTracks(
        stamp_ns=stamp_ns,
        id=np.arange(n),
        position_odom=p,
        velocity_odom=v,
        position_variance=np.full(n, 0.01),
        velocity_variance=np.full(n, 0.01),
        cross_covariance=np.zeros(n),
        radius_m=np.full(n, radius_m),
    )


def empty(local_map):
    occupied = np.zeros((60, 50, 20), bool)
    occupied[:, :, 0] = True
    return local_map(occupied, ground_z=0.1)


@pytest.mark.parametrize("seed", range(4))
def test_distances_are_those_to_all_that_is_swept(local_map, seed):
    rng = np.random.default_rng(seed)
    still = empty(local_map)
    p, v = rng.uniform([2, 2, 1], [10, 8, 2], (3, 3)), rng.uniform(-2, 2, (3, 3)) * [1, 1, 0]
    moved = with_moving(still, tracks(p, v), SECOND // 5, CONFIG)
    cells = rng.integers(0, still.state.shape, (400, 3))
    centres = still.origin_odom + (cells + 0.5) * still.resolution_m
    nearest = np.full(len(cells), np.inf)
    for k in range(3):
        for t in np.linspace(0.2, 0.2 + CONFIG.horizon_s, 400):
            at = p[k] + t * v[k]
            plan = np.maximum(np.hypot(*(centres - at)[:, :2].T) - 0.5, 0.0)
            nearest = np.minimum(nearest, np.hypot(plan, np.maximum(np.abs(centres[:, 2] - at[2]) - 1.5, 0.0)))
    for name in ("distance_m", "unknown_distance_m"):
        expected = np.minimum(getattr(still, name)[tuple(cells.T)], nearest)
        assert np.abs(getattr(moved, name)[tuple(cells.T)] - expected).max() < 0.01
    assert np.array_equal(moved.state, still.state)


@pytest.mark.parametrize("late_ns", [0, SECOND])
def test_no_fresh_track_is_the_map_itself(local_map, late_ns):
    still = empty(local_map)
    assert with_moving(still, None, late_ns, CONFIG) is still
    said = tracks(np.empty((0, 3)), np.empty((0, 3))) if late_ns == 0 else tracks([5, 5, 2], [1, 0, 0])
    assert with_moving(still, said, late_ns, CONFIG) is still


@pytest.mark.parametrize(
    ("first", "v"),
    [([9.0, 5.0], [-1.0, 0.0]), ([6.0, 1.0], [0.0, 1.2]), ([6.0, 9.0], [-0.4, -0.8]), ([0.4, 2.0], [0.8, 0.5])],
    ids=["head-on", "from the right", "from the left", "from behind"],
)
def test_a_walker_is_kept_off(flights, local_map, first, v):
    """The map does not show it: what is kept is kept by its track, told five times a second."""
    occupied = np.zeros((80, 50, 20), bool)
    occupied[:, :, 0] = True
    flight = flights.Flight(local_map, occupied, [2.0, 5.0, 2.0], known=np.ones(occupied.shape, bool), gust=0.0)
    flight.run(0.1)
    flight.send(flights.goal_at([13.0, 5.0, 2.0]))
    gaps = []
    for _ in range(75):
        t = flight.now_ns * 1e-9
        where = np.array([*(np.array(first) + t * np.array(v)), 1.4])
        flight.planning.take_tracks(tracks(where, [*v, 0.0], stamp_ns=flight.now_ns))
        flight.run(0.2)
        at = where[:2] + 0.2 * np.array(v)
        gaps.append(np.hypot(*(flight.vehicle.p[:2] - at)) - 0.3 - flights.HULL_M)
    assert min(gaps) > 0.1
    assert flight.status.state == "reached"


def test_one_gets_out_of_the_way_of_what_comes_as_fast_as_what_stands_allows(local_map):
    """Creeping from a start within the sweep, at 0.6 m/s; 2.5 m/s would do where nothing stands."""
    still = empty(local_map)
    moved = with_moving(still, tracks([2.0, 5.0, 2.0], [1.5, 0.0, 0.0]), 0, CONFIG)
    space = FieldSpace(moved, radius_m=0.86)
    aside = np.array([[4.0, 5.0, 2.0], [4.0, 8.5, 2.0]])

    limits = Limits(
        speed=2.5,
        climb=1.0,
        accel=3.0,
        jerk=20.0,
        yaw_rate=1.0,
        clearance=0.4,
        unknown="optimistic",
        agl_min=0.0,
        agl_max=5.0,
    )

    def speed_at(metres, still_map, path=aside):
        radii = {"hull_radius_m": 0.36, "known_radius_m": 0.76}
        flown = with_speeds(
            path, space, limits, SpeedConfig(), **radii, start=(0.0, 0.0), reach_m=3.5, still_map=still_map
        )
        return flown.speed_at(metres)

    assert speed_at(0.8, None) == pytest.approx(0.6, abs=0.05)
    assert speed_at(0.8, still) > 1.5
    towards = aside[::-1].copy()  # what begins outside is as slow on its way in as before
    assert speed_at(2.7, still, towards) == speed_at(2.7, None, towards)


@pytest.mark.parametrize("seed", range(5))
def test_a_place_is_crossed_if_the_cylinder_comes_over_it_in_time(seed):
    rng = np.random.default_rng(seed)
    places = rng.uniform(-5, 5, (6, 3))
    seen = tracks(rng.uniform(-5, 5, (2, 3)), rng.uniform(-1.5, 1.5, (2, 3)))
    way = seen.position_odom[:, None] + np.linspace(0.0, 4.0, 4001)[:, None] * seen.velocity_odom[:, None]
    away = np.linalg.norm(way[:, :, None, :2] - places[:, :2], axis=-1).min(axis=(0, 1))
    for place, gap_m in zip(places, away, strict=True):
        for hull_m, crossed in ((gap_m - 0.51, False), (gap_m - 0.49, True)):  # 0.3 m of radius and 0.2 of margin
            assert is_crossed(place[None], seen, 0, CONFIG, within_s=4.0, hull_m=hull_m) is crossed
    assert not is_crossed(places, seen, 2 * SECOND, CONFIG, within_s=4.0, hull_m=9.0)  # too old
    assert not is_crossed(places, None, 0, CONFIG, within_s=4.0, hull_m=9.0)
