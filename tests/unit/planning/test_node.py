"""The planning node in flight, and what it does when there is no way."""

import dataclasses

import numpy as np
import pytest

from companion.core import topics
from companion.core.messages import PROVEN, Odometry
from companion.planning import connect, grid, grow, shortcut, smooth, tree
from companion.planning.config import PlanningConfig
from companion.planning.node import PlanningNode
from companion.planning.polyline import arc_length
from companion.planning.route import RouteConfig

SHAPE = (150, 60, 30)  # 30 x 12 x 6 m


def hall():
    """Nothing but a floor; its lowest layer is the ground at 0.1 m."""
    occupied = np.zeros(SHAPE, bool)
    occupied[:, :, 0] = True
    return occupied


def trunk(occupied, x, y, half=0.2):
    i, j, h = round(x / 0.2), round(y / 0.2), round(half / 0.2)
    occupied[i - h : i + h, j - h : j + h] = True


def seen(occupied):
    return np.ones(occupied.shape, bool)


def odometry(p, v=(0.0, 0.0, 0.0), stamp_ns=0):
    return Odometry(
        stamp_ns=stamp_ns,
        p_odom=np.array(p, float),
        q_odom_body=np.array([1.0, 0, 0, 0]),
        v_odom=np.array(v, float),
        omega_body=np.zeros(3),
        pose_variance=np.zeros(6),
        velocity_variance=np.zeros(3),
        measured_ns=stamp_ns,
        quality=1.0,
        reset_counter=0,
    )


class Bench:
    """A planning node at rest in a known world; `plan` feeds a map and returns what it says."""

    def __init__(self, flights, local_map, occupied, p, *, known=None, config=None):
        self.node = PlanningNode(config or PlanningConfig(), hull_radius_m=flights.HULL_M, seed=1)
        self.map = local_map(occupied, known=known, ground_z=0.1)
        list(self.node.handle(topics.ODOMETRY, odometry(p)))

    def goal(self, goal):
        return self._read(self.node.handle(topics.GOAL, goal))

    def plan(self):
        return self._read(self.node.handle(topics.LOCAL_MAP, self.map))

    @staticmethod
    def _read(outputs):
        messages = {output.topic.name: output.message for output in outputs}
        return messages.get("planning/trajectory"), messages.get("planning/status")


def test_it_says_nothing_without_goal_or_map(flights, local_map):
    bench = Bench(flights, local_map, hall(), [2.0, 6.0, 2.0])
    assert bench.plan() == (None, None)
    (output,) = bench.node.tick("watch", 5)
    assert output.message.state == "idle" and output.message.goal_id == -1


def test_a_trajectory_keeps_its_promises(flights, local_map):
    occupied = hall()
    trunk(occupied, 8.0, 6.0)
    bench = Bench(flights, local_map, occupied, [2.0, 6.0, 2.0])
    bench.plan()
    trajectory, status = bench.goal(flights.goal_at([20.0, 6.0, 2.0]))
    p, v, s = trajectory.p_odom, trajectory.speed, arc_length(trajectory.p_odom)
    assert np.allclose(np.diff(s), np.diff(s)[0], rtol=0.02)  # evenly spaced
    assert v[-1] == 0.0 and v.max() <= 3.0 + 1e-9
    assert np.abs(np.diff(v**2) / (2 * np.diff(s))).max() <= 3.0 + 1e-9
    assert np.allclose(p[0], [2.0, 6.0, 2.0]) and np.allclose(p[-1], [20.0, 6.0, 2.0])
    gap = np.maximum(np.abs(np.argwhere(occupied)[None] * 0.2 + 0.1 - p[:, None]) - 0.1, 0)
    assert np.sqrt((gap**2).sum(axis=2)).min() > flights.HULL_M + 0.4
    assert status.state == "flying" and status.distance_m == pytest.approx(s[-1], abs=0.05)


def test_a_goal_in_a_trunk_becomes_the_nearest_free_place(flights, local_map):
    occupied = hall()
    trunk(occupied, 10.0, 6.0, half=0.4)
    flight = flights.Flight(local_map, occupied, [3.0, 6.0, 2.0], known=seen(occupied))
    flight.run(0.1)
    flight.send(flights.goal_at([10.0, 6.0, 2.0], blocked="nearest_free"))
    assert flight.run(20, until=lambda f: f.status.state == "reached")
    assert 1.0 < np.linalg.norm(flight.vehicle.p - [10.0, 6.0, 2.0]) < 1.8
    assert flight.clearance_m > 0.3


def test_a_goal_in_a_trunk_keeps_its_place_although_maps_differ_by_a_voxel(flights, local_map):
    """Seen so, the place nearest to the goal is on one side of the trunk, and seen so, on the other."""
    goal, ends = [10.1, 6.1, 2.0], []
    bench = Bench(flights, local_map, hall(), [3.0, 6.1, 2.0])
    bench.goal(flights.goal_at(goal, blocked="nearest_free"))
    for turn in range(6):
        occupied = hall()
        occupied[48:53, 30, :] = True
        occupied[48:53, 31 if turn % 2 else 29, :] = True
        bench.map = local_map(occupied, ground_z=0.1)
        ends.append(bench.plan()[0].p_odom[-1])
    fresh = [Bench(flights, local_map, hall(), [3.0, 6.1, 2.0]) for _ in range(2)]
    for side, one in zip((29, 31), fresh, strict=True):
        occupied = hall()
        occupied[48:53, 30, :] = occupied[48:53, side, :] = True
        one.map = local_map(occupied, ground_z=0.1)
        one.goal(flights.goal_at(goal, blocked="nearest_free"))
    apart = np.linalg.norm(np.subtract(*(one.plan()[0].p_odom[-1] for one in fresh)))
    assert apart > 1.5  # two sides
    assert np.linalg.norm(np.array(ends) - ends[0], axis=1).max() < 0.3


def test_unknown_taken_for_blocked_waits_for_a_map_that_knows_how_far_it_is(flights, local_map):
    bench = Bench(flights, local_map, hall(), [2.0, 6.0, 2.0])
    told = bench.map
    bench.map = dataclasses.replace(told, unknown_distance_m=np.empty((0, 0, 0), np.float32))
    bench.goal(flights.goal_at([10.0, 6.0, 2.0], unknown="blocked"))
    assert bench.plan() == (None, None)
    assert bench.goal(flights.goal_at([2.0, 6.0, 2.0], kind="hold", unknown="blocked"))[1].state == "flying"  # at once
    bench.goal(flights.goal_at([10.0, 6.0, 2.0], unknown="blocked"))
    bench.map = told
    assert np.linalg.norm(bench.plan()[0].p_odom[-1] - [10.0, 6.0, 2.0]) < 0.3


def test_a_stand_in_with_all_the_clearance_comes_before_the_goal_with_less(flights, local_map):
    occupied = np.zeros((80, 60, 20), bool)
    occupied[50:53, 25:28] = occupied[50:53, 35:38] = True  # 1.4 m of air between two posts
    goal, ends = [10.3, 6.3, 2.0], {}
    for blocked in ("fail", "nearest_free"):
        bench = Bench(flights, local_map, occupied, [2.0, 6.0, 2.0])
        bench.goal(flights.goal_at(goal, blocked=blocked))
        ends[blocked] = bench.plan()[0].p_odom[-1]
    assert np.linalg.norm(ends["fail"] - goal) < 0.3
    assert 0.3 < np.linalg.norm(ends["nearest_free"] - goal) < 1.5


def test_a_goal_in_a_trunk_that_must_not_be_replaced_is_blocked(flights, local_map):
    occupied = hall()
    trunk(occupied, 10.0, 6.0, half=0.4)
    bench = Bench(flights, local_map, occupied, [3.0, 6.0, 2.0])
    bench.plan()
    states = [bench.goal(flights.goal_at([10.0, 6.0, 2.0], blocked="fail"))[1].state]
    states += [bench.plan()[1].state for _ in range(5)]
    assert states == ["flying"] * 4 + ["blocked"] * 2


def test_an_enclosed_goal_is_blocked_after_so_many_replans_and_free_again_when_it_opens(flights, local_map):
    occupied = hall()
    occupied[60:90, 15:45] = True
    occupied[68:82, 23:37] = False
    config = PlanningConfig(blocked_after=3, route=RouteConfig(iterations=200))
    bench = Bench(flights, local_map, occupied, [3.0, 6.0, 2.0], config=config)
    bench.plan()
    states = [bench.goal(flights.goal_at([15.0, 6.0, 2.0]))[1].state]
    for _ in range(4):
        trajectory, status = bench.plan()
        states.append(status.state)
        assert np.allclose(trajectory.p_odom, [3.0, 6.0, 2.0]) and np.all(trajectory.speed == 0.0)
    assert states == ["flying", "flying", "blocked", "blocked", "blocked"]
    bench.map = local_map(hall(), ground_z=0.1)
    trajectory, status = bench.plan()
    assert status.state == "flying" and np.allclose(trajectory.p_odom[-1], [15.0, 6.0, 2.0])


def test_an_enclosed_goal_is_proven_within_a_second(flights, local_map):
    occupied = hall()
    occupied[60:90, 15:45] = True
    occupied[68:82, 23:37] = False
    config = PlanningConfig(route=RouteConfig(planner="portfolio"))
    flight = flights.Flight(local_map, occupied, [3.0, 6.0, 2.0], known=seen(occupied), half_m=20.0, config=config)
    flight.run(0.5)
    flight.send(flights.goal_at([15.0, 6.0, 2.0]))
    assert flight.run(1.0, until=lambda f: f.status.state == "blocked")
    assert flight.status.reason == f"{PROVEN}: no free cells lead to the goal"
    assert np.linalg.norm(flight.vehicle.p - [3.0, 6.0, 2.0]) < 0.2


def test_takeoff_goes_straight_up_through_unknown_but_not_into_a_branch(flights, local_map):
    occupied = hall()
    known = np.zeros(SHAPE, bool)
    known[:, :, :3] = True
    bench = Bench(flights, local_map, occupied, [5.1, 5.1, 0.3], known=known)
    bench.plan()
    trajectory, _ = bench.goal(flights.goal_at([5.1, 5.1, 2.3], kind="takeoff"))
    assert np.allclose(trajectory.p_odom[:, :2], [5.1, 5.1])
    assert trajectory.p_odom[-1, 2] == pytest.approx(2.3) and 0.8 < trajectory.speed.max() <= 1.0 + 1e-9
    occupied[24:27, 24:27, 11] = known[24:27, 24:27, 11] = True  # at 2.2 m
    bench.map = local_map(occupied, known=known, ground_z=0.1)
    trajectory, _ = bench.plan()
    assert 0.9 < trajectory.p_odom[-1, 2] < 2.2 - flights.HULL_M - 0.1


def test_a_takeoff_turns_only_when_it_is_clear_of_the_ground(flights, local_map):
    headings = {}
    for height_m in (0.3, 0.7, 0.9, 1.5):
        bench = Bench(flights, local_map, hall(), [5.1, 5.1, 0.3])
        bench.plan()
        bench.goal(dataclasses.replace(flights.goal_at([5.1, 5.1, 2.3], kind="takeoff"), yaw=2.5))
        list(bench.node.handle(topics.ODOMETRY, odometry([5.1, 5.1, height_m])))
        headings[height_m] = bench.plan()[0].yaw
    assert np.isnan([headings[0.3], headings[0.7]]).all() and headings[0.9] == headings[1.5] == 2.5


def test_hold_brakes_on_the_way_and_stays(flights, local_map):
    occupied = hall()
    flight = flights.Flight(local_map, occupied, [3.0, 6.0, 2.0], known=seen(occupied))
    flight.run(0.1)
    flight.send(flights.goal_at([25.0, 6.0, 2.0]))
    flight.run(4.0)
    assert flight.speeds[-1] > 2.5
    x = flight.vehicle.p[0]
    flight.send(flights.goal_at(flight.vehicle.p, goal_id=2, kind="hold"))
    assert flight.run(4.0, until=lambda f: (f.status.goal_id, f.status.state) == (2, "reached"))
    flight.run(2.0)
    assert flight.vehicle.p[0] - x < 3.0**2 / (2 * 0.7 * 3.0) + 3.0 * 0.35
    assert flight.speeds[-1] < 0.2 and abs(flight.vehicle.p[1] - 6.0) < 0.15


def test_goals_to_fly_through_are_passed_without_stopping(flights, local_map):
    occupied = hall()
    points = [[8.0, 6.0, 2.0], [13.0, 7.0, 2.0], [18.0, 6.0, 2.0], [24.0, 6.0, 2.0]]
    flight = flights.Flight(local_map, occupied, [3.0, 6.0, 2.0], known=seen(occupied))
    flight.run(0.1)
    for n, point in enumerate(points):
        last = n == len(points) - 1
        goal = flights.goal_at(point, goal_id=n + 1, through=not last, after=points[n + 1 :], radius_m=0.5)
        flight.send(goal)
        began = len(flight.speeds)
        assert flight.run(15, until=lambda f, n=n: (f.status.goal_id, f.status.state) == (n + 1, "reached"))
        assert np.linalg.norm(flight.trace - np.array(point), axis=1).min() < 0.5
        if 0 < n < len(points) - 1:
            assert min(flight.speeds[began:]) > 1.8
        flight.run(0.1)  # the mission takes a moment to answer
    flight.run(3.0)
    assert np.linalg.norm(flight.vehicle.p - points[-1]) < 0.3 and flight.speeds[-1] < 0.3


def test_a_start_too_near_to_an_obstacle_escapes_first(flights, local_map):
    occupied = hall()
    trunk(occupied, 5.0, 6.0)
    flight = flights.Flight(local_map, occupied, [5.62, 6.0, 2.0], gust=0.0, known=seen(occupied))
    flight.run(0.1)
    flight.send(flights.goal_at([2.0, 6.0, 2.0]))
    assert flight.run(15, until=lambda f: f.status.state == "reached")
    assert flight.clearance_m > 0.05  # it began at 0.07


def test_a_tree_that_was_not_in_the_first_map_is_flown_around(flights, local_map):
    occupied = hall()
    flight = flights.Flight(local_map, occupied, [3.0, 6.0, 2.0], known=seen(occupied))
    flight.run(0.1)
    flight.send(flights.goal_at([26.0, 6.0, 2.0]))
    flight.run(3.0)
    trunk(occupied, flight.vehicle.p[0] + 5.0, 6.0, half=0.4)
    flight.obstacles = np.argwhere(occupied) * 0.2 + 0.1
    assert flight.run(20, until=lambda f: f.status.state == "reached")
    assert flight.clearance_m > 0.25


@pytest.mark.parametrize(("gust", "slowest"), [(0.0, 0.1), (0.3, 0.4)])
def test_a_wall_that_appears_ends_in_a_stop_before_it(flights, local_map, gust, slowest):
    """In still air it stands; in gusts it is moved about a place that it holds."""
    occupied = hall()
    flight = flights.Flight(local_map, occupied, [3.0, 6.0, 2.0], known=seen(occupied), gust=gust)
    flight.run(0.1)
    flight.send(flights.goal_at([26.0, 6.0, 2.0]))
    flight.run(3.0)
    wall = round((flight.vehicle.p[0] + 4.5) / 0.2)
    occupied[wall : wall + 2] = True
    flight.obstacles = np.argwhere(occupied) * 0.2 + 0.1
    flight.run(5.0)
    assert flight.status.state == "blocked"
    assert flight.speeds[-1] < slowest and flight.clearance_m > 0.15
    place = flight.vehicle.p.copy()
    flight.run(4.0)
    assert np.linalg.norm(np.array(flight.trace[-400:]) - place, axis=1).max() < 0.3
    assert flight.clearance_m > 0.15


@pytest.mark.parametrize("seed", [1, *(pytest.param(n, marks=pytest.mark.slow) for n in range(2, 12))])
def test_an_unknown_forest_is_crossed_with_clearance(flights, local_map, forest, seed):
    """34 m with a view of 9 m, maps of 19 m, gusts, and plans that are 30 ms late."""
    occupied = forest(
        np.random.default_rng(seed), size_m=(40.0, 24.0, 6.0), stems_per_ha=600.0, keep_clear=[(3, 12), (37, 12)]
    )
    known = np.zeros(occupied.shape, bool)
    known[5:25, 50:70, 1:20] = True  # seen while it took off
    flight = flights.Flight(local_map, occupied, [3.0, 12.0, 2.0], half_m=9.6, known=known, seed=seed)
    flight.run(0.1)
    flight.send(flights.goal_at([37.0, 12.0, 2.0], agl_m=2.0))
    assert flight.run(40, until=lambda f: f.status.state == "reached")
    assert flight.clearance_m > 0.3
    assert np.mean(flight.speeds) > 1.4


def test_two_nodes_with_the_same_seed_say_the_same(flights, local_map, forest):
    occupied = forest(np.random.default_rng(4), size_m=(30.0, 20.0, 6.0), stems_per_ha=500.0, keep_clear=[(3, 10)])
    said = []
    for _ in range(2):
        bench = Bench(flights, local_map, occupied, [3.0, 10.0, 2.0])
        bench.plan()
        bench.goal(flights.goal_at([27.0, 10.0, 2.0], blocked="nearest_free"))
        said.append([bench.plan()[0].p_odom.tobytes() for _ in range(3)])
    assert said[0] == said[1]


def test_nothing_is_compiled_in_flight(flights, local_map):
    kernels = [k for module in (connect, grid, grow, shortcut, smooth, tree) for k in vars(module).values()]
    kernels = [k for k in kernels if hasattr(k, "signatures")]
    occupied = hall()
    trunk(occupied, 8.0, 6.0)
    bench = Bench(flights, local_map, occupied, [2.0, 6.0, 2.0])
    before = sum(len(k.signatures) for k in kernels)
    bench.plan()
    bench.goal(flights.goal_at([14.0, 6.0, 2.0], through=True, after=[[20.0, 6.0, 2.0]], agl_m=2.0))
    bench.plan()
    assert sum(len(k.signatures) for k in kernels) == before
