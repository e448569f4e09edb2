"""A vehicle that holds gets out of the way of what moves, and comes back; it stays where nothing does."""

import numpy as np
import pytest

from companion.core import topics
from companion.core.messages import ObstacleTracks

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


@pytest.mark.parametrize("speed", [0.5, 1.0, 1.6])
def test_it_steps_aside_and_comes_back(flights, local_map, speed):
    flight, gaps = hold_among(flights, local_map, [HELD[0] - 4.0, 6.1, 1.4], [speed, 0.0, 0.0], 8.0 / speed)
    assert gaps.min() > 0.3
    flight.run(4.0)
    assert np.linalg.norm(flight.vehicle.p - HELD) < 0.5
    assert np.linalg.norm(flight.vehicle.v) < 0.1


def test_it_stays_where_nothing_comes_near(flights, local_map):
    flight, gaps = hold_among(flights, local_map, [HELD[0] - 4.0, 8.5, 1.4], [1.0, 0.0, 0.0], 8.0)
    assert gaps.min() < 2.0
    assert np.ptp(np.array(flight.trace)[:, :2], axis=0).max() < 0.1
