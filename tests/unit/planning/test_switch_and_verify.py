"""Which new ways replace the old one, what is refused, and that no replan takes a stop back."""

import numpy as np
import pytest

from companion.planning.flown import Flown, braked, with_speeds
from companion.planning.polyline import arc_length
from companion.planning.smooth import SmoothConfig
from companion.planning.space import FieldSpace
from companion.planning.speed_profile import SpeedConfig
from companion.planning.switch import SwitchConfig, as_flown, better, same_class
from companion.planning.verify import first_hit_m

SHAPE = (150, 60, 30)  # 30 x 12 x 6 m
SPEED = SpeedConfig()


def post(*, x=15.0, y=6.0):
    """Ground, and a post of 0.8 m from it to the ceiling."""
    occupied = np.zeros(SHAPE, bool)
    occupied[:, :, 0] = True
    i, j = round(x / 0.2), round(y / 0.2)
    occupied[i - 2 : i + 2, j - 2 : j + 2] = True
    return occupied


@pytest.fixture(scope="module")
def space(local_map):
    return FieldSpace(local_map(post(), ground_z=0.1), radius_m=0.5)


def around(y):
    return np.array([[5.0, 6.0, 2.0], [15.0, y, 2.0], [25.0, 6.0, 2.0]])


def test_ways_past_one_side_of_a_post_are_of_one_class_those_past_both_are_not(space):
    assert same_class(around(8.0), around(9.5), space) and same_class(around(8.0), around(8.0), space)
    assert not same_class(around(8.0), around(4.0), space)
    assert not same_class(around(4.0), around(8.0), space)


@pytest.mark.parametrize("share, expected", [(0.80, (True, True)), (0.95, (False, False))])
def test_one_of_the_same_class_needs_little(space, share, expected):
    config = SwitchConfig(same_share=0.9, same_m=0.0, other_share=0.5, other_m=0.0)
    old = np.array([[5.0, 6.0, 2.0], [15.0, 11.0, 2.0], [25.0, 6.0, 2.0]])
    new_m = share * arc_length(old)[-1]
    new = (
        around(6.0 + np.sqrt((new_m / 2) ** 2 - 100.0)) if new_m > 20 else np.array([[5.0, 8, 2], [5.0 + new_m, 8, 2]])
    )
    assert better(new, old, space, config)[0] is expected[0]


def test_one_of_another_class_must_be_better_by_its_margin(space):
    old, new = around(9.5), around(4.0)
    gain = arc_length(new)[-1] / arc_length(old)[-1]
    eager = SwitchConfig(same_share=0.99, same_m=0.0, other_share=gain + 0.005, other_m=0.0)
    slow = SwitchConfig(same_share=0.99, same_m=0.0, other_share=gain - 0.005, other_m=0.0)
    assert better(new, old, space, eager) == (True, False)
    assert better(new, old, space, slow)[0] is False
    assert better(around(8.0), old, space, slow) == (True, True)  # as long as `new`, but on the old side


def test_a_raw_way_that_smoothing_makes_longer_does_not_replace_the_smooth_old_one(space):
    """Tight around the post, both ways: raw it seems a gain, flown it is the old way again."""
    tight = np.array([[13.6, 6.0, 2.0], [14.4, 6.95, 2.0], [15.6, 6.95, 2.0], [16.4, 6.0, 2.0]])
    old = as_flown(tight[:1], tight, space, SmoothConfig(wished_extra_m=1.5))
    config = SwitchConfig(same_share=0.97, same_m=0.0, other_share=0.97, other_m=0.0)
    assert better(tight, old, space, config)[0] is True
    assert better(as_flown(tight[:1], tight, space, SmoothConfig(wished_extra_m=1.5)), old, space, config)[0] is False


def straight(space, limits):
    path, radii = np.array([[2.0, 6.0, 2.0], [28.0, 6.0, 2.0]]), {"hull_radius_m": 0.35, "known_radius_m": 0.35}
    return with_speeds(path, space, limits, SPEED, **radii, start=(0.0, 0.0), reach_m=26.0)


def test_a_way_into_a_post_is_hit_where_the_hull_meets_it_and_a_free_one_nowhere(local_map, flights):
    empty = np.zeros(SHAPE, bool)
    empty[:, :, 0] = True
    flown = straight(FieldSpace(local_map(empty, ground_z=0.1), radius_m=0.5), flights.LIMITS)
    here, seen = flown.points[0], local_map(post(), ground_z=0.1)
    assert np.isinf(first_hit_m(flown, here, local_map(empty, ground_z=0.1), radius_m=0.35))
    assert 12.0 < first_hit_m(flown, here, seen, radius_m=0.35) < 14.6 - 2.0 - 0.35 + 0.2
    stopped = braked(flown, here, np.zeros(3), flights.LIMITS, SPEED, stop_m=10.0)
    assert np.isinf(first_hit_m(stopped, here, seen, radius_m=0.35))  # it ends before the post
    assert np.isinf(first_hit_m(Flown.standing(here), here, seen, radius_m=0.35))


def test_a_vehicle_beside_something_may_leave_it(local_map, flights):
    seen = local_map(post(x=2.0, y=6.6), ground_z=0.1)  # its side is nearer than the hull's radius
    empty = np.zeros(SHAPE, bool)
    empty[:, :, 0] = True
    flown = straight(FieldSpace(local_map(empty, ground_z=0.1), radius_m=0.5), flights.LIMITS)
    assert np.isinf(first_hit_m(flown, flown.points[0], seen, radius_m=0.35))


def test_every_published_way_is_free_and_can_be_braked_on_before_it_ends(flights, local_map):
    occupied = post(x=12.0, y=6.0) | post(x=18.0, y=7.4) | post(x=18.0, y=4.6)
    flight = flights.Flight(local_map, occupied, [2.0, 6.0, 2.0], gust=0.0, known=np.ones(SHAPE, bool))
    seen = []

    def look(f):
        if f.trajectory is not None and (not seen or seen[-1][0] is not f.trajectory):
            seen.append((f.trajectory, float(np.linalg.norm(f.vehicle.v))))
        return f.status.state == "reached"

    flight.run(0.1)
    flight.send(flights.goal_at([26.0, 6.0, 2.0]))
    assert flight.run(30.0, until=look)
    truth = FieldSpace(local_map(occupied, ground_z=0.1), radius_m=flights.HULL_M, unknown="optimistic")
    assert flight.status.checked >= len(seen) > 20 and flight.status.refused == 0
    for trajectory, _ in seen:
        p, v = trajectory.p_odom, trajectory.speed
        if len(p) < 2:
            continue
        left_m = arc_length(p)[-1] - arc_length(p)
        assert np.all(v**2 <= 2.0 * flights.LIMITS.accel * left_m + 1e-6)  # the backup: it stops on its own way
        assert truth.path_free(p)


def test_no_replan_takes_an_emergency_stop_back(flights, local_map):
    occupied = np.zeros(SHAPE, bool)
    occupied[:, :, 0] = True
    flight = flights.Flight(local_map, occupied, [2.0, 6.0, 2.0], known=np.ones(SHAPE, bool))
    flight.run(0.1)
    flight.send(flights.goal_at([28.0, 6.0, 2.0]))
    flight.run(4.0)
    assert flight.speeds[-1] > 2.0
    flight.verdict = ("hold", 0.0)
    flight.run(3.0)
    place, replans = flight.vehicle.p.copy(), flight.status.checked
    flight.send(flights.goal_at([2.0, 6.0, 2.0], goal_id=2))  # a new goal, and a new way with every map
    flight.run(4.0)
    assert flight.status.checked >= replans + 15 and flight.trajectory.speed.max() > 2.0
    assert np.linalg.norm(flight.vehicle.p - place) < 0.3 and max(flight.speeds[-300:]) < 0.3
    flight.verdict = ("ok", 1.0)
    assert flight.run(20.0, until=lambda f: (f.status.goal_id, f.status.state) == (2, "reached"))
