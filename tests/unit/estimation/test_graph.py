"""The likelihood factor against the quadratic that it stands for, and the smoother alone."""

import gtsam
import numpy as np
import pytest

from companion.core.geometry import exp_so3, quaternion_from_rotation
from companion.core.messages import PoseLikelihood
from companion.estimation.graph import GraphConfig, Smoother, StartNode, likelihood_factor
from companion.estimation.propagation import ImuNoise

G = 9.80665


def likelihood(R, p, H, g, source="lidar"):
    return PoseLikelihood(
        stamp_ns=0,
        p_odom=p,
        q_odom_body=quaternion_from_rotation(R),
        information=H,
        gradient=g,
        source=source,
    )


def test_factor_error_is_the_quadratic_form():
    rng = np.random.default_rng(0)
    R, p = exp_so3(rng.normal(size=3)), rng.normal(size=3)
    S = rng.normal(size=(6, 6))
    H = S @ S.T * 1e4 + np.eye(6) * 1e4
    g = rng.normal(size=6) * 100
    factor = likelihood_factor(7, likelihood(R, p, H, g), weakest=1e-3)
    values = gtsam.Values()
    values.insert(7, gtsam.Pose3(gtsam.Rot3(R), p))
    at_zero = factor.error(values)
    for _ in range(20):
        dx = rng.normal(0, 1e-3, 6)
        moved = gtsam.Pose3(gtsam.Rot3(R @ exp_so3(dx[:3])), p + dx[3:])
        values.update(7, moved)
        expected = 0.5 * dx @ H @ dx - g @ dx
        assert factor.error(values) - at_zero == pytest.approx(expected, rel=2e-2, abs=1e-4)


def test_weak_directions_are_left_out():
    H = np.diag([1e4, 1e4, 1e4, 1.0, 1e4, 1e4])
    factor = likelihood_factor(1, likelihood(np.eye(3), np.zeros(3), H, np.ones(6)), weakest=1e2)
    values = gtsam.Values()
    values.insert(1, gtsam.Pose3(gtsam.Rot3(), np.array([5.0, 0, 0])))
    assert factor.error(values) < 1e-2  # 5 m along the blind direction cost nothing
    assert likelihood_factor(1, likelihood(np.eye(3), np.zeros(3), H, np.ones(6)), weakest=1e9) is None


def smooth(seconds, bias, *, config=None):
    """Hover with wobble; poses are seen exactly, and the IMU is biased."""
    config = config or GraphConfig()
    start = StartNode(
        R=np.eye(3), p=np.zeros(3), v=np.zeros(3), gyro_bias=np.zeros(3), accel_bias=np.zeros(3),
        down=np.array([0, 0, -1.0]),
    )  # fmt: skip
    smoother = Smoother(start, ImuNoise(), config, gravity_m_s2=G)
    H = np.diag([1e6] * 3 + [1e5] * 3)
    dt = 0.005
    newest = None
    for k in range(1, int(seconds * 10)):
        t = (k - 1) * 0.1 + dt * np.arange(1, 21)
        roll, yaw = 0.3 * np.sin(2.0 * t), 0.5 * np.sin(1.1 * t)
        rows, R_last = [], attitude(0.3 * np.sin(2.0 * (t[0] - dt)), 0.5 * np.sin(1.1 * (t[0] - dt)))
        for a, b in zip(roll, yaw, strict=True):
            R = attitude(a, b)
            rate = gtsam.Rot3.Logmap(gtsam.Rot3(R_last.T @ R)) / dt
            rows.append([dt, *rate, *(R_last.T @ [0, 0, G] + bias)])
            R_last = R
        smoother.add(np.array(rows), likelihood(R_last, np.zeros(3), H, np.zeros(6)), t_s=k * 0.1)
        newest = smoother.newest()
    return newest, R_last


def attitude(roll, yaw):
    return exp_so3(np.array([0, 0, yaw])) @ exp_so3(np.array([roll, 0, 0]))


def test_smoother_finds_the_bias_and_forgets_old_nodes():
    bias = np.array([0.05, -0.04, 0.03])
    newest, R = smooth(6.0, bias)
    np.testing.assert_allclose(newest.accel_bias, bias, atol=0.02)
    np.testing.assert_allclose(newest.pose.translation(), 0, atol=0.01)
    np.testing.assert_allclose(newest.pose.rotation().matrix(), R, atol=2e-3)
    assert np.linalg.norm(newest.down - [0, 0, -1]) < 3e-3
    assert newest.factors < 120
    assert (newest.pose_variance > 0).all()


def test_qr_and_cholesky_agree():
    a, _ = smooth(2.0, np.zeros(3))
    b, _ = smooth(2.0, np.zeros(3), config=GraphConfig(factorization="CHOLESKY"))
    np.testing.assert_allclose(a.pose.translation(), b.pose.translation(), atol=1e-6)
    np.testing.assert_allclose(a.accel_bias, b.accel_bias, atol=1e-6)


def test_two_likelihoods_of_one_instant_share_a_node():
    start = StartNode(
        R=np.eye(3), p=np.zeros(3), v=np.zeros(3), gyro_bias=np.zeros(3), accel_bias=np.zeros(3),
        down=np.array([0, 0, -1.0]),
    )  # fmt: skip
    smoother = Smoother(start, ImuNoise(), GraphConfig(), gravity_m_s2=G)
    imu = np.tile([0.005, 0, 0, 0, 0, 0, G], (20, 1))
    H, none = np.eye(6) * 1e5, np.empty((0, 7))
    smoother.add(imu, likelihood(np.eye(3), np.array([0.02, 0, 0]), H, np.zeros(6)), t_s=0.1)
    once = smoother.newest()
    smoother.add(none, likelihood(np.eye(3), np.array([0.02, 0, 0]), H, np.zeros(6), "camera"), t_s=0.1)
    twice = smoother.newest()
    assert twice.factors == once.factors + 1
    assert (twice.pose_variance < once.pose_variance + 1e-12).all()
    assert abs(twice.pose.translation()[0] - 0.02) < abs(once.pose.translation()[0] - 0.02)
