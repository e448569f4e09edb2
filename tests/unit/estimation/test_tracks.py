"""Tracks of moving obstacles: clusters, laws of the tracker, and walkers of the simulator against their truth."""

import numpy as np

from companion.core.messages import RegisteredScan
from companion.core.rig import Rig
from companion.core.topics import LOCAL_MAP, OBSTACLE_TRACKS, REGISTERED
from companion.estimation.tracks.node import ObstacleTracksConfig, ObstacleTracksNode
from companion.estimation.tracks.tracker import Tracker, TrackerConfig
from companion.estimation.tracks.unexpected import (
    Background,
    ClusterConfig,
    Clusters,
    beside,
    clusters,
    joined,
    unexpected,
)
from companion.mapping.node import MappingConfig, MappingNode
from sim.sensors.caster import Caster
from sim.sensors.lidar import Lidar, LidarConfig
from sim.world import load_world

SCAN_NS = 100_000_000


def seen(*centres):
    places = np.array(centres, float).reshape(-1, 3)
    return Clusters(places, np.full(len(places), 0.3), np.full(len(places), 9))


def test_only_points_in_the_midst_of_free_space_are_unexpected():
    state = np.ones((10, 10, 10), np.uint8)
    state[7, 5, 5], state[2, 5, 5] = 2, 0
    known = Background(0, np.zeros(3), 1.0, state)
    x = np.arange(0.5, 10.0)
    points = np.column_stack([x, np.full(10, 5.5), np.full(10, 5.5)]).astype(np.float32)
    found = unexpected(points, np.eye(3), np.zeros(3), known, ClusterConfig())
    np.testing.assert_allclose(found[:, 0], [4.5, 5.5])  # not beside 2 and 7, nor at the box's edge


def test_points_join_into_things_by_distance():
    rng = np.random.default_rng(1)
    things = np.array([[0.0, 0.0, 1.0], [3.0, 0.0, 1.0]])
    points = (things[:, None] + rng.uniform(-0.3, 0.3, (2, 40, 3))).reshape(-1, 3)
    wall = np.column_stack([np.linspace(-3, 3, 60), np.full(60, 5.0), np.ones(60)])
    found = clusters(np.concatenate([points, wall, [[9.0, 9.0, 1.0]]]), ClusterConfig())
    np.testing.assert_allclose(found.centre_odom, things, atol=0.1)  # the wall is too wide, the last point alone
    assert found.points.tolist() == [40, 40]


def test_tracker_follows_two_that_cross_and_is_consistent():
    """Ids stay with their walkers; NEES per degree of freedom over both and 30 s is within 0.5 and 1.5."""
    rng, tracker = np.random.default_rng(2), Tracker(TrackerConfig(accel_density_m2_s3=0.05))
    starts, speeds = np.array([[-5.0, 0.4, 1.0], [5.0, -0.4, 1.0]]), np.array([[1.0, 0.0, 0.0], [-0.8, 0.0, 0.0]])
    nees = []
    for k in range(150):
        truth = starts + 0.1 * k * speeds
        tracker.update(seen(*(truth + rng.normal(0.0, 0.15, (2, 3)))), (k + 1) * SCAN_NS)
        if k > 40:
            assert [t.id for t in tracker.confirmed] == [0, 1]
            for track, p, v in zip(tracker.confirmed, truth, speeds, strict=True):
                off = track.filter.x - np.concatenate([p, v])
                nees.append(off @ np.linalg.solve(track.filter.P, off) / 6)
    assert 0.3 < np.mean(nees) < 1.2  # the model allows accelerations that did not happen


def test_what_stands_is_not_believed_and_what_is_gone_is_dropped():
    tracker = Tracker(TrackerConfig())
    for k in range(20):
        tracker.update(seen([2.0, 0.0, 1.0]), (k + 1) * SCAN_NS)
    assert tracker.confirmed == []
    for k in range(20, 40):
        tracker.update(seen([2.0 + 0.1 * (k - 20), 0.0, 1.0]), (k + 1) * SCAN_NS)
    assert len(tracker.confirmed) == 1
    for k in range(40, 62):
        tracker.update(seen(), (k + 1) * SCAN_NS)
    assert tracker.tracks == []


def test_only_what_is_beside_something_that_moves_is_asked_of_an_older_map():
    points = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 5.0], [4.0, 0.0, 0.0]])
    places = np.array([[1.4, 0.0, 0.0], [9.0, 0.0, 0.0]])
    near = beside(points, places, 1.5)
    np.testing.assert_array_equal(near, points[:2])  # heights do not count
    np.testing.assert_array_equal(joined(points[1:], near), points[[1, 2, 0]])
    assert len(beside(points, np.empty((0, 3)), 1.5)) == 0


def hover(world, seconds, height_m=2.0):
    """Scans from one place through mapping and tracks; yields stamp and the newest message."""
    rig = Rig()
    mapping = MappingNode(MappingConfig(), rig, hull_radius_m=0.36)
    node = ObstacleTracksNode(ObstacleTracksConfig())
    lidar = Lidar(LidarConfig(), rig.lidar, Caster(world.mesh), world.mesh, 0, walkers=world.walkers)
    p, q = np.array([0.0, 0.0, height_m]), np.array([1.0, 0.0, 0.0, 0.0])
    for k in range(1, 10 * seconds + 1):
        swept = lidar.scan(np.tile(p, (2, 1)), np.tile(q, (2, 1)), stamp_ns=k * SCAN_NS, counter=k)
        scan = RegisteredScan(
            stamp_ns=k * SCAN_NS,
            points_body=(swept.points_sensor @ rig.lidar.R_body_sensor.T + rig.lidar.p_body).astype(np.float32),
            miss_dirs_body=(swept.miss_dirs_sensor @ rig.lidar.R_body_sensor.T).astype(np.float32),
            origin_body=rig.lidar.p_body,
            p_odom=p,
            q_odom_body=q,
        )
        told = [o.message for o in node.handle(REGISTERED, scan) if o.topic is OBSTACLE_TRACKS]
        for tracks in told:
            list(mapping.handle(OBSTACLE_TRACKS, tracks))
        for out in mapping.handle(REGISTERED, scan):
            if out.topic is LOCAL_MAP:
                list(node.handle(LOCAL_MAP, out.message))
        yield k * SCAN_NS, told[0] if told else None


def test_a_walker_of_the_simulator_is_followed():
    """It passes 5 m off at 1 m/s: medians of the errors below 0.25 m and 0.2 m/s, and no ghost."""
    options = {"walker_paths": [[[5, -16], [5, 16]]], "walker_speed_m_s": [1.0, 1.0], "walker_radius_m": 0.35}
    world = load_world("empty", seed=4, options=options)
    off, slip = [], []
    for stamp_ns, told in hover(world, 6):
        feet, ahead = (world.walkers.feet(stamp_ns + dt)[0] for dt in (0, SCAN_NS))
        for p, v in zip(told.position_odom, told.velocity_odom, strict=True) if told else ():
            off.append(np.linalg.norm((p - feet)[:2]))
            slip.append(np.linalg.norm((v - (ahead - feet) / 0.1)[:2]))
    assert len(off) > 15
    assert np.median(off) < 0.25
    assert np.max(off) < 0.5
    assert np.median(slip) < 0.2


def test_a_walker_that_turns_back_into_where_it_was_stays_the_same():
    """To and fro at 1.4 m/s, with three turns in 18 s: one id, and never more than 0.5 m off."""
    options = {"walker_paths": [[[5, -4], [5, 4]]], "walker_speed_m_s": [1.4, 1.4], "walker_height_m": 2.8}
    world = load_world("empty", seed=4, options=options)
    off, ids = [], set()
    for stamp_ns, told in hover(world, 18):
        if told is not None:
            off.append(np.linalg.norm((told.position_odom - world.walkers.feet(stamp_ns)[0])[:, :2], axis=1))
            ids |= set(told.id.tolist())
    assert ids == {0}
    assert len(off) > 75 and all(len(a) == 1 for a in off)
    assert np.max(off) < 0.5
