"""The bench of the estimators: its figures on errors that are known, and its faults."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from companion.core import topics
from companion.core.errors import InputError
from companion.core.messages import CameraImage, GroundTruth, ImuSample, LidarScan, Odometry
from companion.runtime.bench.estimation_faults import fault
from companion.runtime.bench.estimation_gaps import gaps_of, returns_of
from companion.runtime.bench.estimation_replay import Run
from companion.runtime.bench.estimation_score import (
    GRAVITY,
    Estimates,
    Truth,
    accuracy,
    nees_of,
    normalised,
    rank_correlation,
    relative_m,
)


def test_normalised_errors_of_an_honest_covariance_average_one():
    rng = np.random.default_rng(1)
    root = rng.normal(size=(4, 4))
    errors = rng.normal(size=(20_000, 4)) @ root.T
    P = np.broadcast_to(root @ root.T, (20_000, 4, 4))
    assert normalised(errors, P).mean() == pytest.approx(1.0, rel=0.03)
    assert normalised(2 * errors, P).mean() == pytest.approx(4.0, rel=0.03)


def test_each_part_of_a_drawn_state_is_honest():
    """True states are drawn around the estimates from the covariance that these claim."""
    rng = np.random.default_rng(2)
    n = 6000
    root = np.diag(np.repeat([2e-3, 0.02, 0.03, 1e-3, 0.02, 0.03], 3)) @ (np.eye(18) + 0.2 * rng.normal(size=(18, 18)))
    e = rng.normal(size=(n, 18)) @ root.T
    R = Rotation.random(n, rng=rng)
    zero = np.zeros((n, 3))
    g = GRAVITY - e[:, 15:]  # the truth is one and the same
    stamps = np.arange(n) * 100_000_000
    estimates = Estimates(stamps, R.as_matrix(), zero, zero, zero, zero, g, np.broadcast_to(root @ root.T, (n, 18, 18)))
    true = Truth((R * Rotation.from_rotvec(e[:, :3])).as_matrix(), e[:, 3:6], e[:, 6:9], GRAVITY)
    nees = nees_of(estimates, true, (stamps, e[:, 9:15]))
    for part in ("tilt", "yaw", "velocity", "gyro_bias", "accel_bias", "position"):
        assert getattr(nees, part) == pytest.approx(1.0, rel=0.08), part


def test_accuracy_ignores_the_frame_and_sees_the_scale():
    t = np.arange(0, 60, 0.1)
    p = np.column_stack([4 * t, 0.2 * np.sin(t), 0.2 * np.cos(t)])
    yaw = Rotation.from_euler("z", 0.3 * np.sin(t)[:, None])
    truth = [
        GroundTruth(
            stamp_ns=round(s * 1e9), p_world=q, q_world_body=r, v_world=np.zeros(3), clearance_m=1.0, contact="",
            armed=True, battery_fraction=1.0,
        )
        for s, q, r in zip(t, p, yaw.as_quat(scalar_first=True), strict=True)
    ]  # fmt: skip
    turn = Rotation.from_euler("zyx", [1.0, 0.1, -0.1])
    stamps = np.array([m.stamp_ns for m in truth])
    same = accuracy(stamps, (turn * yaw).as_matrix(), turn.apply(p) + np.array([1, 2, 3]), truth)
    assert same.ate_m < 1e-9
    assert same.drift_percent < 1e-9
    scaled = accuracy(stamps, (turn * yaw).as_matrix(), 1.01 * turn.apply(p), truth)
    assert scaled.drift_percent == pytest.approx(1.0, rel=0.02)


def test_rank_correlation_has_the_sign_of_honesty():
    error = np.array([0.1, 0.2, 0.3, 0.9])
    assert rank_correlation(1 - error, error) == pytest.approx(1.0)
    assert rank_correlation(error, error) == pytest.approx(-1.0)


def scan(stamp_s):
    points = np.array([[1, 0, 0], [0, 9, 0], [0, 0, 20]], np.float32)
    return LidarScan(
        stamp_ns=round(stamp_s * 1e9), points_sensor=points, point_age_s=np.zeros(3, np.float32),
        miss_dirs_sensor=points[:0], miss_age_s=np.zeros(0, np.float32),
    )  # fmt: skip


def image(stamp_s, value):
    return CameraImage(stamp_ns=round(stamp_s * 1e9), pixels=np.full((4, 6), value, np.uint8))


def test_faults_do_what_their_names_say():
    spoil = fault("range_10,no_camera,lidar_gap_2@5")
    assert len(spoil(topics.LIDAR, scan(1.0)).points_sensor) == 2
    assert spoil(topics.LIDAR, scan(5.5)) is None
    assert spoil(topics.CAMERA, image(1.0, 9)) is None
    frozen = fault("frozen_1@2")
    assert frozen(topics.CAMERA, image(1.9, 7)).pixels[0, 0] == 7
    assert frozen(topics.CAMERA, image(2.5, 8)).pixels[0, 0] == 7
    assert frozen(topics.CAMERA, image(3.1, 9)).pixels[0, 0] == 9
    assert fault("dark_1@0")(topics.CAMERA, image(0.5, 200)).pixels.max() < 8
    sample = ImuSample(stamp_ns=10**10, angular_velocity_body=np.zeros(3), specific_force_body=np.zeros(3))
    assert fault("imu_step_0.5@2")(topics.IMU, sample).specific_force_body[0] == 0.5
    assert fault("clock_jump_0.3@2")(topics.IMU, sample).stamp_ns == 10_300_000_000
    assert fault("none")(topics.IMU, sample) is sample


@pytest.mark.parametrize("text", ["fog_3@2", "range_far", "lidar_gap"])
def test_unknown_faults_are_named_with_what_is_valid(text):
    with pytest.raises(InputError, match="range_METRES"):
        fault(text)


def gap_run(*, jump_m):
    """20 s along x at 2 m/s, sweeps lost from 8 to 11 s; 0.3 m/s of error in y meanwhile, mended within 0.1 s."""
    t = np.arange(0.0, 20.0, 0.01)
    off = np.where((t > 8.0) & (t < 11.0), 0.3 * (t - 8.0), 0.0) + np.where(t >= 11.0, jump_m, 0.0)
    p = np.column_stack([2.0 * t, off, 0 * t])
    v = np.column_stack([0 * t + 2.0, np.where((t > 8.0) & (t < 11.0), 0.3, 0.0), 0 * t])
    odometry = [
        Odometry(
            stamp_ns=round(s * 1e9), p_odom=a, q_odom_body=np.array([1.0, 0, 0, 0]), v_odom=b, omega_body=np.zeros(3),
            pose_variance=np.full(6, 0.36**2), velocity_variance=np.ones(3), measured_ns=round(s * 1e9), quality=1.0,
            reset_counter=0,
        )
        for s, a, b in zip(t, p, v, strict=True)
    ]  # fmt: skip
    sweeps = [SimpleNamespace(stamp_ns=round(s * 1e8), source="lidar") for s in range(200) if not 80 < s < 110]
    truth = Truth(np.zeros((len(t), 3, 3)), np.column_stack([2.0 * t, 0 * t, 0 * t]), v, GRAVITY)
    return Run(odometry=odometry, states=sweeps), truth


def test_a_gap_is_found_in_what_was_used_and_measured_from_its_beginning():
    (gap,) = gaps_of(*gap_run(jump_m=0.05))
    assert (gap.at_s, gap.length_s) == (8.0, 3.0)
    assert gap.error_m == pytest.approx(0.9, abs=0.01) and gap.later_m == pytest.approx(0.05, abs=1e-6)
    assert gap.sigma_m == pytest.approx(0.36) and gap.covered  # 0.9 of 1.08
    assert gap.step_m == pytest.approx(0.85, abs=0.02)  # back at once: odometry's one step
    assert gaps_of(*gap_run(jump_m=-0.3))[0].later_m == pytest.approx(0.3, abs=1e-6)


def test_a_steady_slip_is_the_error_of_a_second():
    """1 cm/s along the body, whatever the heading; a wrong frame says nothing."""
    t = np.arange(0, 20, 0.1)
    R = Rotation.from_euler("z", 0.2 * t[:, None])
    truly = np.cumsum(R.apply([0.3, 0.0, 0.0]), axis=0)
    said = np.cumsum(R.apply([0.301, 0.0, 0.0]), axis=0)
    turn = Rotation.from_euler("z", 0.7)
    true = Truth((turn * R).as_matrix(), turn.apply(truly) + 5.0, np.zeros_like(truly), GRAVITY)
    assert relative_m((t * 1e9).round().astype(np.int64), R.as_matrix(), said, true) == pytest.approx(0.01, rel=0.01)


def test_a_gap_tells_the_error_at_its_end_and_later():
    stamps = np.delete(np.arange(100), range(30, 60)) * 100_000_000
    off = np.zeros((70, 3))
    off[:30], off[30], off[60:] = [1.0, 0.0, 0.0], [1.0, 0.5, 0.0], [1.0, 0.0, 0.02]
    assert returns_of(stamps, off) == ((pytest.approx(0.5), pytest.approx(0.02)),)
