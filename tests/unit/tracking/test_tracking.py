"""Preview, tracking error in flight, and what the node does with old inputs."""

import itertools

import numpy as np
import pytest

from companion.core import topics
from companion.core.geometry import quaternion_from_yaw, wrap_angle
from companion.core.messages import Odometry, SafetyStatus, Trajectory
from companion.tracking.follow import FollowConfig, Follower
from companion.tracking.node import TrackingConfig, TrackingNode
from companion.tracking.path import TrackedPath
from companion.tracking.preview import PreviewConfig, preview

MS = 1_000_000


def trajectory(points, speed, *, stamp_ns=0, yaw=np.nan, accel=3.0, yaw_rate=1.0):
    return Trajectory(
        stamp_ns=stamp_ns,
        goal_id=1,
        p_odom=np.asarray(points, float),
        speed=np.broadcast_to(np.asarray(speed, float), len(points)).copy(),
        accel_limit=accel,
        yaw=yaw,
        yaw_rate_limit=yaw_rate,
    )


def odometry(p, v=(0, 0, 0), *, stamp_ns=0, yaw=0.0):
    return Odometry(
        stamp_ns=stamp_ns,
        p_odom=np.array(p, float),
        q_odom_body=quaternion_from_yaw(yaw),
        v_odom=np.array(v, float),
        omega_body=np.zeros(3),
        pose_variance=np.zeros(6),
        velocity_variance=np.zeros(3),
        measured_ns=stamp_ns,
        quality=1.0,
        reset_counter=0,
    )


def word(action="ok", scale=1.0, *, stamp_ns=0):
    return SafetyStatus(stamp_ns=stamp_ns, action=action, speed_scale=scale, reason="")


def line(total_m=30.0, spacing_m=0.1):
    x = np.arange(0.0, total_m + 1e-9, spacing_m)
    return np.stack([x, 0 * x, 0 * x + 2.0], axis=1)


def circle(radius_m=6.0, turns=1.5):
    a = np.arange(0.0, 2 * np.pi * turns, 0.1 / radius_m)
    return np.stack([radius_m * np.sin(a), radius_m * (1 - np.cos(a)), 0 * a + 2.0], axis=1)


def lane(radius_m=4.0):
    """Out, a half circle, and back: a survey lane."""
    a = np.arange(0.0, np.pi, 0.1 / radius_m)
    turn = np.stack([20 + radius_m * np.sin(a), radius_m * (1 - np.cos(a)), 0 * a + 2.0], axis=1)
    back = line(20.0)[::-1] + np.array([0.0, 2 * radius_m, 0.0])
    return np.vstack([line(19.9), turn, back])


class Vehicle:
    """PX4-like position and velocity loops on a point mass with lag, drag and gusts."""

    def __init__(self, p, *, lag_s=0.15, gust=0.5, seed=0):
        self.p, self.v, self.a = np.array(p, float), np.zeros(3), np.zeros(3)
        self.integral, self.wind = np.zeros(3), np.zeros(3)
        self.lag_s, self.gust, self.rng = lag_s, gust, np.random.default_rng(seed)

    def step(self, demand, dt):
        off = np.nan_to_num(0.95 * (demand.p_odom - self.p)) + demand.v_odom - self.v
        self.integral = np.clip(self.integral + 0.4 * off * dt, -3.0, 3.0)
        wanted = np.clip(1.8 * off + self.integral - 0.2 * self.a + demand.a_odom, -6.0, 6.0)
        self.a += (wanted - self.a) * dt / self.lag_s
        self.wind += -self.wind * dt / 1.5 + self.gust * np.sqrt(2 * dt / 1.5) * self.rng.standard_normal(3)
        self.v = self.v + (self.a - 0.2 * (self.v - self.wind)) * dt
        self.p = self.p + self.v * dt


def fly(points, speed, *, seconds, seed=0, say=lambda t: word(), accel=3.0, refresh=True, gust=0.5, config=None):
    """(trace (N, 3), setpoints) of a node that follows one trajectory, sent anew at 5 Hz."""
    node, vehicle = TrackingNode(config or TrackingConfig()), Vehicle(points[0], seed=seed, gust=gust)
    trace, demands = [], []
    for n in range(round(seconds * 100)):
        now_ns = n * 10 * MS
        if n == 0 or (refresh and n % 20 == 0):
            list(node.handle(topics.TRAJECTORY, trajectory(points, speed, stamp_ns=now_ns, accel=accel)))
        list(node.handle(topics.ODOMETRY, odometry(vehicle.p, vehicle.v, stamp_ns=now_ns)))
        if n % 5 == 0:
            status = say(now_ns * 1e-9)
            list(node.handle(topics.SAFETY, word(status.action, status.speed_scale, stamp_ns=now_ns)))
        if n % 2 == 0:
            (output,) = node.tick("control", now_ns)
            demands.append(output.message)
        vehicle.step(demands[-1], 0.01)
        trace.append(vehicle.p)
    return np.array(trace), demands


def cross_track(trace, points):
    way = np.diff(points, axis=0)
    part = np.einsum("nmk,mk->nm", trace[:, None] - points[None, :-1], way) / np.sum(way**2, axis=1)
    near = points[None, :-1] + np.clip(part, 0, 1)[..., None] * way
    return np.linalg.norm(near - trace[:, None], axis=2).min(axis=1)


def ramp(points, top, accel=2.0):
    s = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    return np.minimum(top, np.sqrt(2 * accel * np.minimum(s, s[-1] - s)))


# --- preview ---------------------------------------------------------------------------


def preview_at(points, speeds, p, v, **options):
    path = TrackedPath(points, speeds, accel_limit=3.0)
    return preview(path, path.at(path.nearest(p)), v, PreviewConfig(drag_per_s=0.0, **options))


def test_preview_on_a_circle_has_tangent_and_centripetal_acceleration():
    points, angle = circle(5.0), 1.0
    p = np.array([5.1 * np.sin(angle), 5 - 5.1 * np.cos(angle), 2.0])  # 0.1 m outside
    v = np.array([2 * np.cos(1.08), 2 * np.sin(1.08), 0.0])
    seen = preview_at(points, np.full(len(points), 2.0), p, v, reaction_s=0.2)
    assert seen.here.s_m == pytest.approx(5.0, abs=0.01)
    assert np.linalg.norm(seen.here.p - p) == pytest.approx(0.1, abs=0.002)
    ahead = angle + 2.0 * 0.2 / 5.0
    assert np.allclose(seen.v, [2 * np.cos(ahead), 2 * np.sin(ahead), 0.0], atol=0.01)
    assert np.allclose(seen.a, 4.0 / 5.0 * np.array([-np.sin(ahead), np.cos(ahead), 0.0]), atol=0.02)


@pytest.mark.parametrize(("x", "sign"), [(2.0, 1.0), (8.0, -1.0)])
def test_velocity_and_acceleration_are_consistent_along_a_speed_ramp(x, sign):
    points = line(10.0)
    seen = preview_at(points, ramp(points, 9.0), np.array([x, 0.0, 2.0]), np.array([2.83, 0.0, 0.0]))
    assert np.allclose(seen.a, [sign * 2.0, 0.0, 0.0], atol=0.05)


def test_a_vehicle_as_fast_as_planned_ahead_is_not_pulled_on():
    points = line(10.0)
    seen = preview_at(points, ramp(points, 9.0), np.array([2.0, 0.0, 2.0]), np.array([3.5, 0.0, 0.0]))
    assert np.allclose(seen.a, 0.0, atol=1e-9)  # the ramp is at 2.83 m/s here, at 3.2 m/s in its reaction time


# --- in flight -------------------------------------------------------------------------


@pytest.mark.parametrize("shape", [circle, lane])
@pytest.mark.parametrize("seed", range(3))
def test_cross_track_error_at_three_metres_a_second(shape, seed):
    points = shape()
    trace, _ = fly(points, ramp(points, 3.0), seconds=15.0, seed=seed)
    error = cross_track(trace, points)
    assert np.sqrt(np.mean(error**2)) <= 0.1
    assert error.max() < 0.3


def test_it_leaves_a_standing_start_and_ends_at_the_end():
    points = line(6.0)
    trace, demands = fly(points, ramp(points, 2.0), seconds=12.0)
    assert np.linalg.norm(trace[-1] - points[-1]) < 0.25  # gusts
    assert trace[:, 0].max() < 6.4
    assert np.linalg.norm(demands[-1].v_odom) < 0.3 and np.linalg.norm(demands[-1].p_odom - points[-1]) < 0.1


@pytest.mark.parametrize(("method", "worst_m"), [("preview", 0.3), ("pure_pursuit", 0.6), ("pid", 0.9)])
@pytest.mark.parametrize("seed", range(2))
def test_every_setpoint_keeps_the_limits_and_every_method_flies(method, worst_m, seed):
    points, top, accel = lane(), 3.0, 3.0
    config = TrackingConfig(follow=FollowConfig(method=method))
    trace, demands = fly(points, ramp(points, top), seconds=22.0, seed=seed, accel=accel, config=config)
    v = np.array([d.v_odom for d in demands])
    assert np.linalg.norm(v, axis=1).max() <= top + 1e-9
    assert np.linalg.norm([d.a_odom for d in demands], axis=1).max() <= accel + 1e-9
    change = np.linalg.norm(np.diff(v, axis=0), axis=1) / 0.02
    assert change.max() <= config.follow.change_share * accel + 1e-6
    assert np.linalg.norm(trace[-1] - points[-1]) < 0.4
    assert cross_track(trace, points).max() < worst_m


def test_a_climb_that_is_off_its_line_goes_on_climbing():
    """0.35 m aside, 0.1 m above the ground, pushed away by 0.25 m/s: the correction is all that it may be."""
    z = np.arange(0.0, 2.01, 0.1)
    points = np.stack([0 * z, 0 * z, z], axis=1)
    node = TrackingNode(TrackingConfig())
    list(node.handle(topics.TRAJECTORY, trajectory(points, ramp(points, 1.0) + 0.3 * (z < 0.05), stamp_ns=0)))
    for n in range(60):
        list(node.handle(topics.ODOMETRY, odometry([-0.35, 0.0, 0.1], [-0.25, 0.0, 0.0], stamp_ns=n * 20 * MS)))
        list(node.handle(topics.SAFETY, word(stamp_ns=n * 20 * MS)))
        (output,) = node.tick("control", n * 20 * MS)
    assert output.message.v_odom[0] > 0.9 and output.message.v_odom[2] > 0.5


@pytest.mark.parametrize("top", [1.5, 3.0])
def test_the_end_is_not_overshot_without_wind(top):
    points = line(12.0)
    trace, _ = fly(points, ramp(points, top), seconds=16.0, gust=0.0)
    assert trace[:, 0].max() < 12.1 and trace[-1, 0] == pytest.approx(12.0, abs=0.03)


def test_a_path_that_turns_off_gives_no_jump():
    follower = Follower(FollowConfig(), period_s=0.02)
    state = odometry([1.0, 0.0, 2.0], v=(2.0, 0.0, 0.0))
    follower.take(trajectory(line(), 2.0))
    before = follower.setpoint(0, state, scale=1.0)
    follower.take(trajectory(line()[:, [1, 0, 2]] + np.array([1.0, 0.0, 0.0]), 2.0))  # to the left
    after = follower.setpoint(20 * MS, state, scale=1.0)
    assert np.linalg.norm(after.v_odom - before.v_odom) <= 2.0 * 3.0 * 0.02 + 1e-9


def test_position_is_asked_for_near_hover_only():
    follower = Follower(FollowConfig(), period_s=0.02)
    follower.take(trajectory(line(), 2.0))
    fast = follower.setpoint(0, odometry([5.0, 0.1, 2.0], v=(2.0, 0.0, 0.0)), scale=1.0)
    assert np.all(np.isnan(fast.p_odom)) and fast.v_odom[1] < 0.0
    follower.take(trajectory(line(5.0), np.r_[np.full(50, 0.3), 0.0]))
    slow = follower.setpoint(20 * MS, odometry([5.0, 0.1, 2.0]), scale=1.0)
    assert np.allclose(slow.p_odom, [5.0, 0.0, 2.0], atol=1e-9)


def test_astray_it_first_comes_back():
    speeds = []
    for off in (0.0, 0.8, 2.0):
        follower = Follower(FollowConfig(), period_s=0.02)
        follower.take(trajectory(line(), 2.0))
        state = odometry([5.0, off, 2.0], v=(2.0, 0.0, 0.0))
        demands = [follower.setpoint(n * 20 * MS, state, scale=1.0) for n in range(60)]
        speeds.append(demands[-1].v_odom[0])
    assert speeds[0] > speeds[1] > speeds[2] > 0.3


def test_a_vehicle_that_stands_is_not_told_to_brake():
    points = line(6.0)
    seen = preview_at(points, ramp(points, 2.0), np.array([5.6, 0.0, 2.0]), np.zeros(3))
    assert np.allclose(seen.a, 0.0) and seen.v[0] > 0.5


@pytest.mark.parametrize(("action", "scale"), [("hold", 0.0), ("land", 0.0)])
def test_hold_brakes_on_the_path_and_stays(action, scale):
    points = line(30.0)
    trace, demands = fly(
        points, ramp(points, 3.0), seconds=9.0, say=lambda t: word(action, scale) if t > 4.0 else word()
    )
    speeds = np.array([np.linalg.norm(d.v_odom) for d in demands])
    assert speeds[195] > 2.7 and np.all(speeds[260:] < 0.4)
    assert np.abs(np.diff(speeds[200:260])).max() < 1.4 * 3.0 * 0.02  # bounded braking
    assert trace[-1, 0] - trace[400, 0] < 3.0**2 / (2 * 3.0) * 1.5 + 0.5
    assert cross_track(trace, points).max() < 0.3
    assert len({tuple(d.p_odom) for d in demands[300:]}) == 1  # one place, whatever the wind does


def test_slow_scales_the_speed_and_recovers():
    points = line(30.0)
    _, demands = fly(
        points, ramp(points, 3.0), seconds=8.0, say=lambda t: word("slow", 0.4) if 3.0 < t < 5.0 else word()
    )
    speeds = np.array([np.linalg.norm(d.v_odom) for d in demands])
    assert speeds[240] == pytest.approx(1.2, abs=0.15)
    assert speeds[-1] == pytest.approx(3.0, abs=0.2)


def test_an_old_trajectory_is_braked_on():
    points = line(40.0)
    trace, demands = fly(points, ramp(points, 3.0), seconds=6.0, refresh=False)
    assert np.linalg.norm(demands[-1].v_odom) < 0.4
    assert trace[-1, 0] < 3.0 * 1.5 + 3.0


# --- heading ---------------------------------------------------------------------------


def test_yaw_rate_is_limited_and_the_nose_points_along_the_path():
    points = line(20.0)[:, [1, 0, 2]]  # towards +y
    _, demands = fly(points, ramp(points, 1.5), seconds=6.0)
    yaw = np.array([d.yaw for d in demands])
    rates = np.array([wrap_angle(b - a) for a, b in itertools.pairwise(yaw)]) / 0.02
    assert np.abs(rates).max() <= 1.0 + 1e-9
    assert yaw[-1] == pytest.approx(np.pi / 2, abs=0.1)
    assert yaw[40] == pytest.approx(0.82, abs=0.05)  # turning at the limit, 1 rad/s


def test_yaw_is_kept_on_a_vertical_path_and_obeyed_when_asked_for():
    z = np.arange(0.0, 4.0, 0.1)
    up = np.stack([0 * z, 0 * z, z], axis=1)
    _, demands = fly(up, ramp(up, 1.0), seconds=4.0)
    assert max(abs(d.yaw) for d in demands) < 1e-9
    node = TrackingNode(TrackingConfig())
    list(node.handle(topics.TRAJECTORY, trajectory(up, 0.0, yaw=-3.0)))
    list(node.handle(topics.ODOMETRY, odometry(up[0], yaw=3.0)))
    list(node.handle(topics.SAFETY, word()))
    for _ in range(50):
        (output,) = node.tick("control", 0)
    assert output.message.yaw == pytest.approx(-3.0)  # over the seam, the short way


# --- stale inputs ----------------------------------------------------------------------


def ready_node(points):
    node = TrackingNode(TrackingConfig())
    list(node.handle(topics.TRAJECTORY, trajectory(points, 1.0)))
    list(node.handle(topics.ODOMETRY, odometry(points[0])))
    list(node.handle(topics.SAFETY, word()))
    return node


def test_no_setpoint_on_stale_odometry():
    node = ready_node(line())
    list(node.handle(topics.SAFETY, word(stamp_ns=150 * MS)))
    assert len(list(node.tick("control", 200 * MS))) == 1
    assert list(node.tick("control", 201 * MS)) == []
    list(node.handle(topics.ODOMETRY, odometry([0, 0, 2], stamp_ns=220 * MS)))
    assert len(list(node.tick("control", 240 * MS))) == 1


def test_no_setpoint_on_stale_safety():
    node = ready_node(line())
    list(node.handle(topics.ODOMETRY, odometry([0, 0, 2], stamp_ns=250 * MS)))
    assert len(list(node.tick("control", 300 * MS))) == 1
    assert list(node.tick("control", 301 * MS)) == []


def test_no_setpoint_before_anything_was_heard():
    assert list(TrackingNode(TrackingConfig()).tick("control", 0)) == []


def test_before_the_first_trajectory_it_holds_where_it_is():
    node = TrackingNode(TrackingConfig())
    list(node.handle(topics.SAFETY, word()))
    for p in ([1.0, 2.0, 0.3], [1.1, 2.0, 0.3], [2.0, 2.0, 0.3]):
        list(node.handle(topics.ODOMETRY, odometry(p, yaw=0.7)))
        (output,) = node.tick("control", 0)
        held = [1.0, 2.0, 0.3] if p[0] < 1.5 else p
        assert np.allclose(output.message.p_odom, held) and np.allclose(output.message.v_odom, 0.0)
        assert output.message.yaw == pytest.approx(0.7)


def test_an_older_trajectory_does_not_replace_a_newer():
    node = ready_node(line())
    list(node.handle(topics.TRAJECTORY, trajectory(line()[:, [1, 0, 2]], 1.0, stamp_ns=100 * MS)))
    list(node.handle(topics.TRAJECTORY, trajectory(line(), 1.0, stamp_ns=50 * MS)))
    for _ in range(20):
        (output,) = node.tick("control", 110 * MS)
    assert output.message.v_odom[1] > 0.9


def test_a_path_of_one_point_is_held():
    node = ready_node(np.array([[1.0, 2.0, 3.0]]))
    (output,) = node.tick("control", 0)
    assert np.allclose(output.message.p_odom, [1.0, 2.0, 3.0]) and np.allclose(output.message.a_odom, 0.0)
