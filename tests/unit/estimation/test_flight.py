"""Short synthetic flights through the nodes: drift, consistency, order, repetition."""

import hashlib
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from companion.core import topics
from companion.core.geometry import log_so3, rotation_from_quaternion, skew
from companion.core.messages import CameraImage, ImuSample, LidarScan, MapFromOdom, freeze
from companion.core.rig import Rig
from companion.estimation.config import EstimationConfig
from companion.estimation.node import GraphNode, LioNode, PropagatorNode
from companion.estimation.so3 import tilt_free
from companion.estimation.start import StartConfig, is_at_rest, start_filter
from tests.unit.estimation.synthetic import ACCEL_BIAS, GYRO_BIAS, REST_S, G, record, trunks

TOPIC = {
    ImuSample: topics.IMU,
    LidarScan: topics.LIDAR,
    CameraImage: topics.CAMERA,
    MapFromOdom: topics.MAP_FROM_ODOM,
}


def run(events, *, config=None, nodes=None):
    """Feed (arrival, message) to the three nodes at once; topic name -> messages."""
    config = config or EstimationConfig()
    nodes = nodes or [LioNode(config, Rig()), PropagatorNode(config), GraphNode(config, Rig())]
    heard = {t.name: [] for t in topics.ALL}
    for _, first in events:
        queue = [(TOPIC[type(first)], first)]
        while queue:
            topic, message = queue.pop(0)
            for node in nodes:
                if topic.name in node.handlers:
                    for out in node.handle(topic, message):
                        heard[out.topic.name].append(freeze(out.message))
                        queue.append((out.topic, out.message))
    return heard


@pytest.fixture(scope="module")
def forest():
    truth, events = record(12.0)
    return truth, events, run(events)


@pytest.fixture(scope="module")
def with_camera():
    truth, events = record(7.0, camera=True)
    return truth, events, run(events)


def columns(messages, position):
    t = np.array([m.stamp_ns for m in messages]) * 1e-9
    return t, np.array([getattr(m, position) for m in messages])


def aligned_rms(truth, messages, position="p_odom"):
    t, p = columns(messages, position)
    q = truth.pose(t)[1]
    R, _ = Rotation.align_vectors(q - q.mean(axis=0), p - p.mean(axis=0))
    return np.sqrt(((R.apply(p - p.mean(axis=0)) + q.mean(axis=0) - q) ** 2).sum(axis=1).mean())


def test_drift_in_the_forest(forest):
    truth, _, heard = forest
    length = np.linalg.norm(np.diff(truth.p, axis=0), axis=1).sum()
    assert length > 20
    for topic in (topics.LIO_STATE, topics.ODOMETRY, topics.SMOOTHED):
        position = "p_map" if topic is topics.SMOOTHED else "p_odom"
        assert aligned_rms(truth, heard[topic.name], position) < 0.03
    t, p = columns(heard[topics.LIO_STATE.name], "p_odom")
    true = np.linalg.norm(truth.pose(t[-1:])[1][0] - truth.pose(t[:1])[1][0])
    assert abs(np.linalg.norm(p[-1] - p[0]) - true) < 0.005 * length


def test_every_scan_is_used_and_told_in_order(forest):
    _, events, heard = forest
    start_ns = heard[topics.LIO_STATE.name][0].stamp_ns
    scans = [m.stamp_ns for _, m in events if isinstance(m, LidarScan) and m.stamp_ns >= start_ns]
    registered = [m.stamp_ns for m in heard[topics.REGISTERED.name]]
    assert registered[:3] == scans[: len(registered)][:3]
    assert len(registered) >= len(scans) - 1
    states = heard[topics.LIO_STATE.name]
    assert states[0].source == "start"
    assert all(s.inlier_fraction > 0.05 for s in states[1:])  # the first see little of the map
    assert np.mean([s.inlier_fraction for s in states[1:]]) > 0.6
    assert heard[topics.WHY.name] == []


def test_registered_points_lie_on_the_ground_or_a_trunk(forest):
    """Deskewed scans, put where the vehicle truly was, show the world: noise is 0.02 m."""
    truth, _, heard = forest
    world = trunks(path=truth.p)
    for scan in heard[topics.REGISTERED.name][10::15]:
        R, p = truth.pose(np.array([scan.stamp_ns * 1e-9]))
        points = R.apply(scan.points_body) + p
        points = points[np.linalg.norm(scan.points_body, axis=1) < 20]
        trunk = np.abs(np.linalg.norm(points[:, None, :2] - world[:, :2], axis=2) - world[:, 2]).min(axis=1)
        off = np.minimum(np.abs(points[:, 2]), trunk)
        assert len(points) > 1000
        assert np.sqrt((off**2).mean()) < 0.04
        assert scan.points_body.dtype == np.float32
        rays = R.apply(scan.miss_dirs_body)
        assert len(rays) > 100
        # What saw nothing looked up, or far, or nearer than the sensor sees (on the ground).
        blind = (rays[:, 2] < -0.1).mean()
        assert blind < (0.01 if p[0, 2] > 1.0 else 0.6)


def errors(truth, start, state):
    """Attitude, velocity and gravity errors in odom, whose axes the start defines."""
    t = np.array([start.stamp_ns, state.stamp_ns]) * 1e-9
    R_true = truth.pose(t)[0].as_matrix()
    gauge = rotation_from_quaternion(start.q_odom_body) @ R_true[0].T
    theta = log_so3(rotation_from_quaternion(state.q_odom_body).T @ gauge @ R_true[1])
    return theta, gauge @ truth.velocity(t[1]) - state.v_odom, gauge @ [0, 0, -G] - state.gravity_odom


def tilt_error(truth, state):
    """Error of gravity as the body feels it, R'g, without its length: value and covariance."""
    R = rotation_from_quaternion(state.q_odom_body)
    felt = R.T @ state.gravity_odom
    true = truth.pose(np.array([state.stamp_ns * 1e-9]))[0].as_matrix()[0].T @ [0, 0, -G]
    J = np.zeros((3, 18))
    J[:, :3], J[:, 15:18] = skew(felt), R.T
    across = np.linalg.svd(felt[None])[2][1:]
    return across @ (true - felt), across @ J @ state.covariance @ J.T @ across.T


def test_attitude_velocity_and_bias_are_as_good_as_they_say(forest):
    truth, _, heard = forest
    states = heard[topics.LIO_STATE.name]
    nees = {"tilt": [], "v": [], "bg": [], "ba": [], "g": []}
    for state in states[20:]:
        theta, v, g = errors(truth, states[0], state)
        bg, ba = GYRO_BIAS - state.gyro_bias_body, ACCEL_BIAS - state.accel_bias_body
        tilt, of_tilt = tilt_error(truth, state)
        nees["tilt"].append(tilt @ np.linalg.solve(of_tilt, tilt) / 2)
        for name, e, k in (("v", v, 6), ("bg", bg, 9), ("ba", ba, 12), ("g", g[:2], 15)):
            C = state.covariance[k : k + len(e), k : k + len(e)]
            nees[name].append(e @ np.linalg.solve(C, e) / len(e))
        # The first sweeps fix the map's attitude to some mrad, which the filter does not model.
        assert np.linalg.norm(theta) < 5e-3
    mean = {name: float(np.mean(values)) for name, values in nees.items()}
    assert all(0.05 < m < 4.0 for m in mean.values()), mean
    last = heard[topics.LIO_STATE.name][-1]
    assert np.linalg.norm(last.gyro_bias_body - GYRO_BIAS) < 1.5e-3
    assert np.linalg.norm(last.accel_bias_body - ACCEL_BIAS) < 0.06


def test_covariance_stays_symmetric_and_positive(forest):
    for state in forest[2][topics.LIO_STATE.name][::10]:
        np.testing.assert_allclose(state.covariance, state.covariance.T, atol=1e-15)
        assert np.linalg.eigvalsh(state.covariance)[0] > 0


def test_graph_agrees_with_the_filter_and_finds_the_bias(forest):
    truth, _, heard = forest
    smoothed = {s.stamp_ns: s for s in heard[topics.SMOOTHED.name]}
    states = {s.stamp_ns: s for s in heard[topics.LIO_STATE.name]}
    assert len(smoothed) > 90
    for stamp, s in smoothed.items():
        R = rotation_from_quaternion(s.q_map_odom)
        level = np.arccos(min(1.0, R[2, 2]))
        assert np.degrees(level) < 1.0
        np.testing.assert_allclose(R @ states[stamp].p_odom + s.p_map_odom, s.p_map, atol=1e-9)
        assert np.linalg.norm(s.p_map_odom) < 0.05  # what is left when the tilt is taken away
    first, last = smoothed[min(smoothed)], smoothed[max(smoothed)]
    horizontal = slice(0, 2)
    before = np.linalg.norm((first.accel_bias_body - ACCEL_BIAS)[horizontal])
    after = np.linalg.norm((last.accel_bias_body - ACCEL_BIAS)[horizontal])
    assert after < 0.6 * before
    assert np.linalg.norm(last.gyro_bias_body - GYRO_BIAS) < 1.5e-3
    # `map` is level: its height error is smaller than that of `odom`.
    end = truth.pose(np.array([last.stamp_ns * 1e-9]))[1][0]
    start = truth.pose(np.array([heard[topics.LIO_STATE.name][0].stamp_ns * 1e-9]))[1][0]
    in_odom = states[last.stamp_ns].p_odom - (end - start)
    in_map = last.p_map - (end - start)
    assert np.linalg.norm(in_map) < 0.6 * np.linalg.norm(in_odom)


def test_what_loops_say_comes_before_the_correction_of_the_graph(forest):
    """map <- odom is (map <- odom of the start), which the graph knows, after (odom of the start <- odom of now)."""
    _, events, heard = forest
    turn = Rotation.from_euler("z", 0.1)
    loops = MapFromOdom(
        stamp_ns=0, p_map_odom=np.array([0.5, -0.2, 0.1]), q_map_odom=turn.as_quat(scalar_first=True), closures=1
    )
    begun = [e for e in events if e[0] < 4 * 10**9]
    with_loops = run([(0, loops), *begun])[topics.SMOOTHED.name]
    alone = {s.stamp_ns: s for s in heard[topics.SMOOTHED.name]}
    assert len(with_loops) > 10
    for s in with_loops:
        R, R_alone = (rotation_from_quaternion(m.q_map_odom) for m in (s, alone[s.stamp_ns]))
        np.testing.assert_allclose(R, R_alone @ turn.as_matrix(), atol=1e-9)
        np.testing.assert_allclose(s.p_map_odom, R_alone @ loops.p_map_odom + alone[s.stamp_ns].p_map_odom, atol=1e-9)
        spin = R @ R_alone.T
        np.testing.assert_allclose(s.v_map, spin @ alone[s.stamp_ns].v_map, atol=1e-9)


def test_map_odom_moves_without_jumps(forest):
    smoothed = forest[2][topics.SMOOTHED.name]
    p = np.array([s.p_map for s in smoothed]) - np.array([s.p_map_odom for s in smoothed])
    shifts = np.array([s.p_map_odom for s in smoothed])
    assert np.linalg.norm(np.diff(shifts, axis=0), axis=1).max() < 0.03
    R = [rotation_from_quaternion(s.q_map_odom) for s in smoothed]
    turns = [np.linalg.norm(log_so3(a.T @ b)) for a, b in pairwise(R)]
    assert np.degrees(max(turns)) < 0.3
    assert np.isfinite(p).all()


def test_odometry_is_continuous_and_on_time(forest):
    _, _, heard = forest
    odometry = heard[topics.ODOMETRY.name]
    t, p = columns(odometry, "p_odom")
    v = np.array([o.v_odom for o in odometry])
    np.testing.assert_allclose(np.diff(t), 0.01, atol=1e-9)
    assert odometry[0].stamp_ns > heard[topics.LIO_STATE.name][0].stamp_ns
    jump = p[1:] - p[:-1] - 0.5 * (v[1:] + v[:-1]) * 0.01
    assert np.linalg.norm(jump, axis=1).max() < 0.05
    assert np.percentile(np.linalg.norm(jump, axis=1), 95) < 0.01
    assert {o.reset_counter for o in odometry} == {0}
    for o in odometry[::50]:
        assert o.measured_ns <= o.stamp_ns
        assert (o.pose_variance >= 0).all()
        assert (o.velocity_variance > 0).all()
        assert abs(np.linalg.norm(o.q_odom_body) - 1) < 1e-9
    assert odometry[-1].quality > 0.5


def test_odometry_owns_up_to_dead_reckoning(forest):
    _, events, _ = forest
    cut = 6.0
    blind = [(t, m) for t, m in events if isinstance(m, ImuSample) or m.stamp_ns < cut * 1e9]
    odometry = run([e for e in blind if e[0] < cut + 2.0])[topics.ODOMETRY.name]
    late = [o for o in odometry if o.stamp_ns > (cut + 0.6) * 1e9]
    assert all(o.quality == 0.0 for o in late)
    sigma = np.sqrt([o.pose_variance[3:].sum() for o in late])
    assert (np.diff(sigma) > 0).all()
    # The state of `late` is 1.4 s and about 4 m beyond the last scan.
    assert sigma[-1] > 0.02 * 3


def test_same_bytes_twice(forest):
    _, events, _ = forest
    short = [e for e in events if e[0] < 4.0]

    def digest():
        heard = run(short)
        hashed = hashlib.sha256()
        for messages in heard.values():
            for message in messages:
                for name in message.__slots__:
                    value = getattr(message, name)
                    hashed.update(value.tobytes() if isinstance(value, np.ndarray) else repr(value).encode())
        return hashed.hexdigest()

    assert digest() == digest()


def test_camera_and_lidar_in_order(with_camera):
    truth, events, heard = with_camera
    states = heard[topics.LIO_STATE.name]
    stamps = [s.stamp_ns for s in states]
    assert stamps == sorted(stamps)
    images = sum(isinstance(m, CameraImage) and m.stamp_ns * 1e-9 > REST_S + 2.5 for _, m in events)
    used = sum(s.source == "camera" and s.stamp_ns * 1e-9 > REST_S + 2.5 for s in states)
    assert used >= 0.95 * images
    assert aligned_rms(truth, states) < 0.03
    likelihoods = heard[topics.LIKELIHOOD.name]
    assert len(likelihoods) == len(states) - 1
    assert {m.source for m in likelihoods} == {"lidar", "camera"}


def test_camera_holds_where_the_lidar_is_blind():
    """A plain, LiDAR to 8 m: nothing but the camera sees horizontal motion."""
    truth, events = record(8.0, camera=True, forest=False, max_range=8.0)
    seen = run(events)[topics.LIO_STATE.name]
    blind_config = EstimationConfig(camera=replace_struct(EstimationConfig().camera, enabled=False))
    blind = run(events, config=blind_config)[topics.LIO_STATE.name]
    assert aligned_rms(truth, seen) < 0.08
    assert aligned_rms(truth, seen) < 0.2 * aligned_rms(truth, blind)


def replace_struct(struct, **changes):
    return type(struct)(**{f: changes.get(f, getattr(struct, f)) for f in struct.__struct_fields__})


def test_bad_input_never_stops_the_nodes(forest):
    truth, events, _ = forest
    rng = np.random.default_rng(5)
    spoiled = []
    for at, m in events:
        if at > 7.0:
            break
        chance = rng.random()
        if isinstance(m, ImuSample):
            if chance < 0.02:
                continue  # lost
            if chance < 0.04:
                spoiled.append((at, m))  # twice
            if chance < 0.05:
                m = replace(m, stamp_ns=m.stamp_ns - 20_000_000)
            elif chance < 0.06:
                m = replace(m, specific_force_body=np.array([np.nan, 0, 0]))
        elif chance < 0.2:
            points = m.points_sensor.copy()
            points[rng.random(len(points)) < 0.3] = np.nan
            m = replace(m, points_sensor=points)
        elif chance < 0.3:
            none, no_age = np.empty((0, 3), np.float32), np.empty(0, np.float32)
            m = replace(m, points_sensor=none, point_age_s=no_age)
        elif chance < 0.4:
            spoiled.append((at, m))
        elif chance < 0.5:
            m = replace(m, stamp_ns=m.stamp_ns - 300_000_000)
        elif chance < 0.55:
            m = replace(m, stamp_ns=m.stamp_ns + 10**13)
        spoiled.append((at, m))
    heard = run(spoiled)
    assert len(heard[topics.REGISTERED.name]) > 30
    assert aligned_rms(truth, heard[topics.LIO_STATE.name]) < 0.1
    odometry = heard[topics.ODOMETRY.name]
    assert all(np.isfinite(o.p_odom).all() for o in odometry)


def rest_samples(R, rng, n=200, noise=0.02):
    force = R.T @ [0, 0, G]
    return np.column_stack([np.tile(GYRO_BIAS, (n, 1)), np.tile(force, (n, 1))]) + rng.normal(0, noise, (n, 6)) * [
        0.05, 0.05, 0.05, 1, 1, 1,
    ]  # fmt: skip


@pytest.mark.parametrize("rpy", [(0, 0, 0), (6, -9, 0), (-20, 15, 0)])
def test_a_tilted_start_gives_level_odom_with_yaw_zero(rpy):
    R = Rotation.from_euler("ZYX", np.radians(rpy[::-1])).as_matrix()
    f = start_filter(rest_samples(R, np.random.default_rng(0)), StartConfig(), t_s=0.0)
    np.testing.assert_allclose(f.state.R, R, atol=1e-3)
    np.testing.assert_allclose(f.state.g, [0, 0, -9.80665], atol=1e-12)
    np.testing.assert_allclose(f.state.gyro_bias, GYRO_BIAS, atol=3e-4)
    assert not f.state.p.any()
    # Gravity and bias cannot be told apart at rest: moving both leaves the reading as it is.
    J = np.zeros((3, 18))
    J[:, 12:15], J[:, 15:18] = np.eye(3), -f.state.R.T
    assert np.sqrt((J @ f.P @ J.T).trace()) < 0.03
    assert np.sqrt(f.P[12:15, 12:15].trace()) > 0.13
    np.testing.assert_allclose(tilt_free(-f.state.g), np.eye(3), atol=1e-12)


def test_rest_is_told_from_motion():
    rng = np.random.default_rng(1)
    still = rest_samples(np.eye(3), rng)
    config = StartConfig()
    assert is_at_rest(still, config)
    assert not is_at_rest(still + rng.normal(0, 0.5, still.shape), config)
    assert not is_at_rest(still + np.array([0.3, 0, 0, 0, 0, 0]), config)
    assert not is_at_rest(still + np.array([0, 0, 0, 0, 0, 3.0]), config)


def test_nothing_is_said_before_the_vehicle_stood_still(forest):
    _, events, _ = forest
    flying = [e for e in events if 4.0 < e[0] < 5.5]
    heard = run(flying)
    assert all(not messages for messages in heard.values())
