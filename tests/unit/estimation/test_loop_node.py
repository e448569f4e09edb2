"""The loop node on scans of a synthetic loop: corrections move the past towards truth, never the present."""

from dataclasses import replace

import numpy as np
import pytest

from companion.core.geometry import quaternion_from_rotation, rotation_from_quaternion
from companion.core.messages import LioState, MapFromOdom, PoseCorrections, RegisteredScan, Why
from companion.core.topics import CORRECTIONS, LIO_STATE, MAP_FROM_ODOM, ODOMETRY, REGISTERED, SETPOINT, TRAJECTORY
from companion.estimation.loop_node import LoopNode, LoopNodeConfig
from companion.stack import NODES
from tests.unit.estimation.test_loops import circle, drifting, forest, scans

EMPTY = np.empty((0, 3), np.float32)


def registered(points, R, p, stamp_ns):
    q = quaternion_from_rotation(R)
    return RegisteredScan(
        stamp_ns=stamp_ns,
        points_body=points,
        miss_dirs_body=EMPTY,
        origin_body=np.zeros(3),
        p_odom=p,
        q_odom_body=q,
    )


def started(stamp_ns):
    """A filter that has just begun."""
    return LioState(
        stamp_ns=stamp_ns,
        source="start",
        **{name: np.zeros(3) for name in ("p_odom", "v_odom", "gyro_bias_body", "accel_bias_body", "gravity_odom")},
        **_rest_of(LioState),
    )


def _rest_of(kind):
    known = {"stamp_ns", "source", "p_odom", "v_odom", "gyro_bias_body", "accel_bias_body", "gravity_odom"}
    values = {"q_odom_body": np.array([1.0, 0, 0, 0]), "covariance": np.full((18, 18), 1e-8)}
    return {name: values.get(name, 0) for name in kind.__dataclass_fields__ if name not in known}


@pytest.fixture(scope="module")
def lap():
    R_true, p_true = circle(1.3)
    rng = np.random.default_rng(3)
    R, p = drifting(R_true, p_true, rng)
    clouds = list(scans(R_true, p_true, forest(3, p_true), rng))
    return [registered(c, R[k], p[k], 10**8 * (k + 1)) for k, c in enumerate(clouds)], p_true


def run(node, messages):
    """Everything that it says, in order."""
    return [out.message for m in messages for out in node.handle(REGISTERED, m)]


def test_corrections_bring_the_past_near_truth_and_leave_the_present(lap):
    messages, p_true = lap
    said = run(LoopNode(LoopNodeConfig()), messages)
    corrections = [m for m in said if isinstance(m, PoseCorrections)]
    assert len(corrections) >= 1
    last = corrections[-1]
    assert np.all(np.diff(last.stamps_ns) > 0)
    present = next(m for m in messages if m.stamp_ns == last.stamps_ns[-1])
    assert last.p_odom[-1] == pytest.approx(present.p_odom, abs=1e-6)
    number = last.stamps_ns // 10**8 - 1
    wanted = np.linalg.norm(p_true[number[0]] - p_true[number[-1]])
    drifted = np.linalg.norm(messages[number[0]].p_odom - messages[number[-1]].p_odom)
    assert abs(np.linalg.norm(last.p_odom[0] - last.p_odom[-1]) - wanted) < 0.3 * abs(drifted - wanted)
    why = next(m for m in said if isinstance(m, Why))
    assert "seen again" in why.what
    assert "trunks agree" in why.because


def test_map_from_odom_puts_the_present_where_the_first_pose_says(lap):
    """In `map` the first keyframe stays: the newest one then lies where truth has it, seen from there."""
    messages, p_true = lap
    said = run(LoopNode(LoopNodeConfig()), messages)
    last = [m for m in said if isinstance(m, MapFromOdom)][-1]
    corrections = [m for m in said if isinstance(m, PoseCorrections)][-1]
    assert last.stamp_ns == corrections.stamp_ns
    assert last.closures >= 1
    R = rotation_from_quaternion(last.q_map_odom)
    assert R @ corrections.p_odom[0] + last.p_map_odom == pytest.approx(messages[0].p_odom, abs=1e-3)
    present = next(m for m in messages if m.stamp_ns == last.stamp_ns)
    number = last.stamp_ns // 10**8 - 1
    drifted = np.linalg.norm(present.p_odom - p_true[number])
    assert np.linalg.norm(R @ present.p_odom + last.p_map_odom - p_true[number]) < 0.3 * drifted


def test_rotations_of_corrections_are_unit_quaternions(lap):
    last = [m for m in run(LoopNode(LoopNodeConfig()), lap[0]) if isinstance(m, PoseCorrections)][-1]
    for q in last.q_odom_body:
        R = rotation_from_quaternion(q)
        assert pytest.approx(np.eye(3), abs=1e-9) == R @ R.T


def test_odometry_that_is_sure_of_itself_is_believed_and_that_is_said(lap):
    node, said = LoopNode(LoopNodeConfig()), []
    for message in lap[0]:
        list(node.handle(LIO_STATE, replace(started(message.stamp_ns), source="lidar")))
        said += [out.message for out in node.handle(REGISTERED, message)]
    assert not [m for m in said if isinstance(m, PoseCorrections)]
    assert "it would be farther off than odometry can be" in {m.because for m in said if isinstance(m, Why)}


def test_without_drift_nothing_is_said():
    R_true, p_true = circle(1.2)
    rng = np.random.default_rng(3)
    clouds = scans(R_true, p_true, forest(3, p_true), rng)
    messages = [registered(c, R_true[k], p_true[k], 10**8 * (k + 1)) for k, c in enumerate(clouds)]
    node = LoopNode(LoopNodeConfig())
    assert run(node, messages) == []
    assert len(node.finder.closures) > 0


def test_a_new_start_forgets_the_old_frame(lap):
    node = LoopNode(LoopNodeConfig())
    half = len(lap[0]) // 2
    run(node, lap[0][:half])
    (said,) = [out.message for out in node.handle(LIO_STATE, started(lap[0][half].stamp_ns))]
    assert (said.closures, said.p_map_odom.tolist(), said.q_map_odom.tolist()) == (0, [0, 0, 0], [1, 0, 0, 0])
    assert run(node, lap[0][half:]) == []
    assert node.finder.closures == []


def test_switched_off_or_fed_nonsense_it_says_nothing(lap):
    assert run(LoopNode(LoopNodeConfig(enabled=False)), lap[0][:5]) == []
    node = LoopNode(LoopNodeConfig())
    bad = registered(lap[0][0].points_body, np.eye(3), np.array([np.nan, 0, 0]), 1)
    assert run(node, [bad, lap[0][3], lap[0][0]]) == []
    assert node.finder.stamps_ns == [lap[0][3].stamp_ns]
    assert CORRECTIONS in LoopNode.publishes


def test_only_maps_and_the_frame_of_goals_hear_of_loops_so_that_no_setpoint_can_step():
    """Odometry, plans and setpoints come from nodes that know neither corrections nor `map_from_odom`."""
    hearing = {n.__name__ for n in NODES if {CORRECTIONS, MAP_FROM_ODOM} & set(n.subscribes)}
    moving = {n.__name__ for n in NODES if {ODOMETRY, LIO_STATE, REGISTERED, SETPOINT, TRAJECTORY} & set(n.publishes)}
    assert hearing == {"MappingNode", "LandmarkNode", "GraphNode"}
    assert not hearing & moving
