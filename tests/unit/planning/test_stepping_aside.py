"""A vehicle that holds gets out of the way of what moves, and comes back; it stays where nothing does."""

import dataclasses

import numpy as np
import pytest

from companion.core import topics
from companion.core.messages import ObstacleTracks
from companion.planning.aside import Aside
from companion.planning.moving import MovingConfig, with_moving
from companion.planning.situation import Situation

HELD = np.array([6.0, 6.0, 2.0])
WALKER_M = 0.35


def hall():
    occupied = np.zeros((64, 64, 24), bool)
    occupied[:, :, 0] = True
    return occupied


def tracks(p, v, stamp_ns):
    return ObstacleTracks(
        stamp_ns=stamp_ns,
        id=np.zeros(1, np.int64),
        position_odom=np.array(p)[None],
        velocity_odom=np.array(v)[None],
        position_variance=np.full(1, 0.01),
        velocity_variance=np.full(1, 0.01),
        cross_covariance=np.zeros(1),
        radius_m=np.full(1, WALKER_M),
    )


def hold_among(flights, local_map, start, velocity, seconds):
    """Distance in plan from hull to walker, at each step of 0.1 s, for a vehicle that holds at HELD."""
    flight = flights.Flight(local_map, hall(), HELD, known=np.ones_like(hall()), gust=0.0)
    flight.run(0.1)
    flight.send(flights.goal_at(HELD, goal_id=2, kind="hold", blocked="nearest_free"))
    gaps = []
    for k in range(round(10 * seconds)):
        walker = np.array(start) + 0.1 * k * np.array(velocity)
        if k % 2 == 0:
            list(flight.planning.handle(topics.OBSTACLE_TRACKS, tracks(walker, velocity, flight.now_ns)))
        flight.run(0.1)
        gaps.append(np.linalg.norm((flight.vehicle.p - walker)[:2]) - WALKER_M - flights.HULL_M)
    return flight, np.array(gaps)


@pytest.mark.parametrize("speed", [0.8, 1.2])
def test_a_landing_waits_until_the_walker_has_passed(flights, local_map, speed):
    flight = flights.Flight(local_map, hall(), HELD, known=np.ones_like(hall()), gust=0.0)
    flight.run(0.3)
    flight.send(flights.goal_at(HELD, goal_id=2, kind="land", blocked="nearest_free", radius_m=0.5))
    gaps, states = [], []
    for k in range(round(80 / speed)):
        walker, v = np.array([HELD[0] - 4.0 + 0.1 * k * speed, 6.1, 1.4]), [speed, 0.0, 0.0]
        if k % 2 == 0:
            list(flight.planning.handle(topics.OBSTACLE_TRACKS, tracks(walker, v, flight.now_ns)))
        flight.run(0.1)
        states.append((walker[0] < HELD[0] + 0.5, flight.status.state))
        gaps.append(np.linalg.norm((flight.vehicle.p - walker)[:2]) - WALKER_M - flights.HULL_M)
    assert {state for comes, state in states[2:] if comes} == {"flying"}
    assert min(gaps) > 0.3
    assert states[-1] == (False, "reached")
    assert np.linalg.norm(flight.vehicle.p[:2] - HELD[:2]) < 2.0


@pytest.mark.parametrize("speed", [0.5, 1.0, 1.6])
def test_it_steps_aside_and_comes_back(flights, local_map, speed):
    flight, gaps = hold_among(flights, local_map, [HELD[0] - 4.0, 6.1, 1.4], [speed, 0.0, 0.0], 8.0 / speed)
    assert gaps.min() > 0.3
    flight.run(4.0)
    assert np.linalg.norm(flight.vehicle.p - HELD) < 0.5
    assert np.linalg.norm(flight.vehicle.v) < 0.1


def test_who_has_reached_a_place_in_the_stead_of_the_goal_goes_on_to_it_when_it_is_free(flights, local_map):
    occupied = hall()
    occupied[29:32, 29:32] = True
    flight = flights.Flight(local_map, occupied, HELD - [4.0, 0, 0], known=np.ones_like(occupied), gust=0.0)
    flight.send(flights.goal_at(HELD, blocked="nearest_free"))
    flight.run(8.0)
    assert flight.status.state == "reached"
    assert 0.8 < np.linalg.norm(flight.vehicle.p - HELD) < 2.0
    flight.eyes.occupied[29:32, 29:32, 1:] = False  # it was somebody who stood there
    flight.run(5.0)
    assert np.linalg.norm(flight.vehicle.p - HELD) < 0.3
    assert flight.status.state == "reached"


def test_it_stays_where_nothing_comes_near(flights, local_map):
    flight, gaps = hold_among(flights, local_map, [HELD[0] - 4.0, 8.5, 1.4], [1.0, 0.0, 0.0], 8.0)
    assert gaps.min() < 2.0
    assert np.ptp(np.array(flight.trace)[:, :2], axis=0).max() < 0.1


def test_it_waits_for_a_map_that_serves_its_policy_and_then_goes_on_until_told_otherwise(local_map):
    """Without the distance to unknown space no plan that takes that for blocked can be made: no error, no leaving."""
    still = local_map(hall())
    poor = dataclasses.replace(still, unknown_distance_m=np.zeros((0, 0, 0), np.float32))
    coming = tracks([HELD[0] - 1.0, HELD[1], 1.4], [1.0, 0.0, 0.0], 0)

    def at(one, among=coming):
        moving = with_moving(one, among, 0, MovingConfig())
        return Situation(p_odom=HELD, v_odom=np.zeros(3), local_map=moving, still_map=one, ground=None, ground_z=0.0)

    aside = Aside(HELD, 0.6, "blocked")
    assert not aside.is_left(at(still, among=None))
    assert not aside.is_left(at(poor))
    assert aside.is_left(at(still, among=None))  # it has begun: the way back is planned, too
    assert Aside(HELD, 0.6, "stop_before").is_left(at(poor))
