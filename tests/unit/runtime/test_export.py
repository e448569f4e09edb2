"""A flight log as MCAP: every message with its values, and a scene for viewers."""

import numpy as np
import pytest
from rosbags.highlevel import AnyReader
from typer.testing import CliRunner

from companion.cli.main import app
from companion.config import Config, dump_config
from companion.core import topics
from companion.core.geometry import exp_so3, quaternion_from_rotation, rotate, rotation_from_quaternion
from companion.core.messages import LocalMap, Odometry, RangeReading, RegisteredScan, SmoothedState, Trajectory, Why
from companion.core.rig import Rig
from companion.runtime.export import export
from companion.runtime.flight_log import FlightLog
from companion.runtime.inbox import InboxLog
from companion.runtime.log_file import Header
from companion.runtime.mcap_file import samples
from companion.runtime.viewer import sensor_frames, views_of

MISSION = "version: 1\nname: up\nsteps:\n  - {do: takeoff, alt: 1.5}\n  - {do: land}\n"
TILT = exp_so3(np.array([0.1, -0.2, 0.7]))
Q = quaternion_from_rotation(TILT)
P = np.array([1.0, 2.0, 3.0])
MS = 1_000_000


def header(group: str, *nodes: str) -> Header:
    return Header(group=group, nodes=nodes, seed=0, mission=MISSION, config=dump_config(Config()))


def odometry(stamp_ns: int) -> Odometry:
    return Odometry(
        stamp_ns=stamp_ns,
        p_odom=P,
        q_odom_body=Q,
        v_odom=np.array([1.0, 0.0, 0.5]),
        omega_body=np.array([0.0, 0.0, 0.3]),
        pose_variance=np.arange(1.0, 7.0),
        velocity_variance=np.array([1.0, 2.0, 3.0]),
        measured_ns=stamp_ns,
        quality=0.9,
        reset_counter=0,
    )


def smoothed(stamp_ns: int) -> SmoothedState:
    zero = np.zeros(3)
    return SmoothedState(
        stamp_ns=stamp_ns, p_map=P, q_map_body=Q, v_map=zero, gyro_bias_body=zero, accel_bias_body=zero,
        p_map_odom=np.array([0.5, 0.0, 0.0]), q_map_odom=np.array([1.0, 0.0, 0.0, 0.0]), pose_variance=np.ones(6),
        factors=3,
    )  # fmt: skip


def read(path):
    found = {}
    with AnyReader([path]) as reader:
        for connection, _, data in reader.messages():
            found.setdefault(connection.topic, []).append(reader.deserialize(data, connection.msgtype))
    return found


@pytest.fixture
def flight(tmp_path):
    log = FlightLog(tmp_path / "flight.log")
    log.begin(header("lockstep", "PropagatorNode", "GraphNode", "TrackingNode"))
    for k in range(5):
        log.published(k * 10 * MS, "PropagatorNode", topics.ODOMETRY, odometry(k * 10 * MS))
        log.published(k * 10 * MS, "SimNode", topics.RANGE, RangeReading(stamp_ns=k * 10 * MS, range_m=0.5 * k))
    log.published(50 * MS, "GraphNode", topics.SMOOTHED, smoothed(45 * MS))
    log.close()
    return tmp_path


def test_every_message_is_there_and_the_frames_hang_together(flight):
    done = export(flight, flight / "a.mcap")
    found = read(flight / "a.mcap")
    assert done.messages == sum(map(len, found.values()))
    assert not done.unknown
    assert [m.range for m in found["/drone1/sensors/range"]] == [0.0, 0.5, 1.0, 1.5, 2.0]
    assert len(found["/drone1/estimation/odometry"]) == len(found["/drone1/odom"]) == 5
    links = {(t.header.frame_id, t.child_frame_id) for m in found["/tf"] for t in m.transforms}
    assert links == {("odom", "base_link"), ("map", "odom")}
    static = {(t.header.frame_id, t.child_frame_id) for m in found["/tf_static"] for t in m.transforms}
    assert static == {("base_link", "lidar"), ("base_link", "camera"), ("base_link", "range_finder")}


def test_times_are_those_of_the_log_and_of_the_stamps(flight):
    export(flight, flight / "a.mcap")
    last = next(s for s in samples(flight / "a.mcap") if s.topic == "drone1/estimation/smoothed")
    assert (last.log_ns, last.publish_ns) == (50 * MS, 45 * MS)


def test_odometry_in_ros_turns_velocity_and_its_variance_into_the_body():
    tf, odom = views_of(topics.ODOMETRY, odometry(7 * MS))
    placed = tf.value["transforms"][0]["transform"]
    q = np.array([placed["rotation"][k] for k in "wxyz"])
    assert np.allclose(rotation_from_quaternion(q), TILT)
    twist = odom.value["twist"]["twist"]["linear"]
    assert np.allclose(rotate(Q, np.array([twist[k] for k in "xyz"])), [1.0, 0.0, 0.5])
    variance = odom.value["twist"]["covariance"].reshape(6, 6)[:3, :3]
    assert np.allclose(TILT @ variance @ TILT.T, np.diag([1.0, 2.0, 3.0]))
    pose = odom.value["pose"]["covariance"].reshape(6, 6)
    assert np.allclose(np.diag(pose), [4, 5, 6, 1, 2, 3])  # ROS: position first
    assert tf.where.shared and not odom.where.shared


def test_sensor_frames_are_the_rigs():
    rig = Rig()
    lidar = sensor_frames(rig).value["transforms"][0]
    q = np.array([lidar["transform"]["rotation"][k] for k in "wxyz"])
    assert np.allclose(rotation_from_quaternion(q), rig.lidar.R_body_sensor)
    assert lidar["transform"]["translation"] == {"x": 0.08, "y": 0.0, "z": 0.06}


def test_clouds_paths_and_texts(tmp_path):
    state = np.zeros((4, 5, 6), np.uint8)
    state[1, 2, 3], state[3, 4, 5], state[0, 0, 0] = 2, 2, 1
    far = np.zeros((4, 5, 6), np.float32)
    local_map = LocalMap(
        stamp_ns=1, origin_odom=P, resolution_m=0.5, state=state, distance_m=far, unknown_distance_m=far,
        ground_z_odom=far[..., 0],
    )  # fmt: skip
    points = np.arange(12, dtype=np.float32).reshape(4, 3)
    scan = RegisteredScan(
        stamp_ns=1, points_body=points, miss_dirs_body=points[:0], origin_body=P, p_odom=P, q_odom_body=Q
    )
    path = np.array([[0.0, 0, 1], [1, 0, 1], [2, 0, 1]])
    trajectory = Trajectory(
        stamp_ns=1, goal_id=1, p_odom=path, speed=np.ones(3), accel_limit=1.0, yaw=0.0, yaw_rate_limit=1.0
    )
    log = FlightLog(tmp_path / "flight.log", store_all=True)
    log.begin(header("lockstep", "MappingNode"))
    log.published(1, "MappingNode", topics.LOCAL_MAP, local_map)
    log.published(1, "LioNode", topics.REGISTERED, scan)
    log.published(1, "PlanningNode", topics.TRAJECTORY, trajectory)
    log.published(1, "MissionNode", topics.WHY, Why(stamp_ns=1, node="mission", what="hold", because="no map"))
    log.close()
    export(tmp_path, tmp_path / "a.mcap", vehicle="d7")
    found = read(tmp_path / "a.mcap")
    assert "/d7/mapping/local_map" not in found  # only with maps=True
    assert np.array_equal(found["/d7/cloud"][0].data.view(np.float32).reshape(-1, 3), points)
    assert [p.pose.position.x for p in found["/d7/path"][0].poses] == [0, 1, 2]
    assert (found["/rosout"][0].name, found["/rosout"][0].msg) == ("mission", "hold: no map")
    export(tmp_path, tmp_path / "b.mcap", vehicle="d7", maps=True)
    assert read(tmp_path / "b.mcap")["/d7/mapping/local_map"][0].state.size == 120


def test_what_the_log_does_not_store_is_counted(tmp_path):
    log = FlightLog(tmp_path / "flight.log")
    log.begin(header("lockstep", "LioNode"))
    scan = RegisteredScan(
        stamp_ns=1, points_body=np.zeros((1, 3), np.float32), miss_dirs_body=np.zeros((0, 3), np.float32),
        origin_body=P, p_odom=P, q_odom_body=Q,
    )  # fmt: skip
    log.published(1, "LioNode", topics.REGISTERED, scan)
    log.close()
    assert export(tmp_path, tmp_path / "a.mcap").unknown == {"estimation/registered_scan": 1}


def test_logs_of_a_live_flight_are_merged_each_message_once(tmp_path):
    """The odometry of the control group is heard by the world group, too, the smoothed state by both."""
    control = InboxLog(tmp_path / "inbox-control.log", header("control", "PropagatorNode", "SafetyNode"))
    world = InboxLog(tmp_path / "inbox-world.log", header("world", "PlanningNode", "MissionNode"))
    for k in range(4):
        control.published(10 * k, "PropagatorNode", topics.ODOMETRY, odometry(10 * k))
        world.received(10 * k + 3, topics.ODOMETRY, odometry(10 * k))
        control.received(10 * k + 5, topics.SMOOTHED, smoothed(k))
        world.received(10 * k + 4, topics.SMOOTHED, smoothed(k))
    control.close()
    world.close()
    export(tmp_path, tmp_path / "a.mcap")
    counts = {topic: len(messages) for topic, messages in read(tmp_path / "a.mcap").items()}
    assert counts["/drone1/estimation/odometry"] == counts["/drone1/estimation/smoothed"] == 4
    assert counts["/tf"] == 8


def test_the_command_writes_a_file_and_recovers_a_torn_one(flight):
    result = CliRunner().invoke(app, ["export", str(flight), "--mcap", str(flight / "a.mcap")])
    assert result.exit_code == 0, result.output
    whole = read(flight / "a.mcap")
    (flight / "torn.mcap").write_bytes((flight / "a.mcap").read_bytes()[:-40])
    result = CliRunner().invoke(app, ["export", str(flight / "torn.mcap"), "--mcap", str(flight / "b.mcap")])
    assert result.exit_code == 0, result.output
    assert {k: len(v) for k, v in read(flight / "b.mcap").items()} == {k: len(v) for k, v in whole.items()}
