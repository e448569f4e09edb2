"""Where the vehicle may come down."""

import numpy as np
import pytest

from companion.core import topics
from companion.core.messages import RangeReading
from companion.planning.landing import Columns, LandingConfig, beam_fault, stopping_place

CONFIG = LandingConfig()


def world(local_map, change=None, *, unseen=None, bumps=None):
    occupied = np.zeros((80, 80, 24), bool)
    occupied[:, :, 0] = True
    known = np.ones(occupied.shape, bool)
    if change is not None:
        occupied[change] = True
    if unseen is not None:
        known[unseen] = False
    made = local_map(occupied, known=known, ground_z=0.1)
    if bumps is not None:
        ground = made.ground_z_odom.copy()
        ground[bumps[0]] = bumps[1]
        made = type(made)(**{n: ground if n == "ground_z_odom" else getattr(made, n) for n in made.__slots__})
    return made


def columns(made):
    return Columns(made, top_z_odom=3.0, radius_m=0.55, config=CONFIG)


HERE = np.array([8.1, 8.1, 3.0])
BESIDE = np.array([5.1, 8.1, 3.0])
AROUND = (slice(38, 44), slice(38, 44))  # of 8.1 m, cells of 0.2 m


def test_over_open_ground_it_comes_down_where_it_is(local_map):
    seen = columns(world(local_map))
    assert seen.fault(HERE) == "" and np.array_equal(seen.nearest(HERE), HERE)


@pytest.mark.parametrize(
    ("made", "words"),
    [
        ({"change": (40, 41, 6)}, "something is in the column"),  # a branch, 1.3 m up
        ({"unseen": (*AROUND, slice(4, 14))}, "not seen"),
        ({"bumps": ((slice(40, 60), slice(30, 60)), 1.0)}, "uneven"),
        ({"bumps": (AROUND, np.nan)}, "ground was not seen"),
    ],
)
def test_it_says_what_is_wrong_and_moves_aside(local_map, made, words):
    seen = columns(world(local_map, **made))
    assert words in seen.fault(HERE)
    place = seen.nearest(HERE)
    assert 0.2 < np.linalg.norm(place - HERE) < 3.0 and place[2] == HERE[2]
    assert seen.fault(place) == "" and seen.fault(BESIDE) == ""


def test_what_is_above_the_vehicle_or_is_ground_does_not_matter(local_map):
    assert columns(world(local_map, (40, 40, 20))).fault(HERE) == ""
    assert columns(world(local_map, (*AROUND, slice(0, 3)))).fault(HERE) == ""


def test_where_nothing_is_free_there_is_no_place(local_map):
    seen = columns(world(local_map, (slice(None), slice(None), 7)))
    assert seen.nearest(HERE) is None
    assert "outside" in seen.fault(np.array([99.0, 0.0, 3.0]))


def test_the_stopping_place_is_that_of_constant_braking():
    place = stopping_place(np.array([1.0, 0.0, 2.0]), np.array([0.0, 3.0, 0.0]), accel=3.0)
    assert np.allclose(place, [1.0, 1.5, 2.0])


def test_the_planner_flies_beside_a_stump_before_it_lands(flights, local_map):
    occupied = np.zeros((160, 60, 20), bool)
    occupied[:, :, 0] = True
    occupied[38:43, 28:33, :6] = True
    flight = flights.Flight(local_map, occupied, [8.1, 6.1, 2.0], known=np.ones(occupied.shape, bool), gust=0.0)
    flight.run(0.3)
    flight.send(flights.goal_at(flight.vehicle.p, goal_id=5, kind="land", radius_m=0.5))
    assert flight.run(12.0, until=lambda f: (f.status.goal_id, f.status.state) == (5, "reached"))
    flight.run(2.0)
    assert np.linalg.norm(flight.vehicle.p[:2] - [8.1, 6.1]) > 0.8 and flight.speeds[-1] < 0.2
    assert Columns(flight._map(), top_z_odom=2.0, radius_m=0.35, config=CONFIG).fault(flight.vehicle.p) == ""


def test_the_beam_says_what_the_map_does_not_hold():
    level, leaning = np.array([1.0, 0.0, 0.0, 0.0]), np.array([np.cos(0.5), np.sin(0.5), 0.0, 0.0])
    assert beam_fault(2.0, level, 2.1, CONFIG) == "" and beam_fault(2.0 / np.cos(1.0), leaning, 2.1, CONFIG) == ""
    assert "1.1 m above the ground" in beam_fault(1.0, level, 2.1, CONFIG)
    assert beam_fault(np.nan, level, 2.1, CONFIG) == "" == beam_fault(1.0, level, np.nan, CONFIG)


def test_a_branch_that_only_the_range_finder_sees_is_avoided(flights, local_map):
    occupied = np.zeros((160, 60, 20), bool)
    occupied[:, :, 0] = True
    start = np.array([8.1, 6.1, 2.0])
    flight = flights.Flight(local_map, occupied, start, known=np.ones(occupied.shape, bool), gust=0.0)
    flight.run(0.3)
    flight.send(flights.goal_at(start, goal_id=5, kind="land"))
    for _ in range(60):
        near = np.linalg.norm(flight.vehicle.p[:2] - start[:2]) < 0.5
        reading = RangeReading(stamp_ns=flight.now_ns, range_m=0.9 if near else float(flight.vehicle.p[2]) - 0.1)
        list(flight.planning.handle(topics.RANGE, reading))
        flight.run(0.1)
    assert flight.status.state == "reached"
    assert 0.7 < np.linalg.norm(flight.vehicle.p[:2] - start[:2]) < 2.0


def test_without_a_place_the_planner_stops_and_says_why(flights, local_map):
    occupied = np.zeros((160, 60, 20), bool)
    occupied[:, :, :4] = True
    flight = flights.Flight(local_map, occupied, [8.1, 6.1, 2.0], known=np.ones(occupied.shape, bool), gust=0.0)
    flight.run(0.3)
    flight.send(flights.goal_at(flight.vehicle.p, goal_id=5, kind="land"))
    flight.run(1.0)
    assert flight.status.state == "blocked" and "no place to land" in flight.status.reason
