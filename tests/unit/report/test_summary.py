"""The figures of a flight, on tracks whose answer is known."""

import math
from dataclasses import replace

import numpy as np
import pytest

from companion.core import topics
from companion.core.geometry import quaternion_conjugate, quaternion_from_yaw, quaternion_multiply, rotate
from companion.core.messages import GroundTruth, Odometry, SmoothedState
from companion.report.summary import aligned, drift_percent, path_length, trajectory_figures
from companion.report.tracks import Track, Tracks

HZ = 50


def fly(p_world, *, scale=1.0, offset_yaw=0.0, offset=(0.0, 0.0, 0.0), yaw=0.3):
    """Truth along p_world; an estimate that is scaled, turned and shifted against it."""
    tracks = Tracks()
    q_turn = quaternion_from_yaw(offset_yaw)
    for k, p in enumerate(p_world):
        stamp_ns = round(k * 1e9 / HZ)
        q = quaternion_from_yaw(yaw)
        v = (p_world[min(k + 1, len(p_world) - 1)] - p) * HZ
        tracks.truth.append(
            GroundTruth(
                stamp_ns=stamp_ns, p_world=p, q_world_body=q, v_world=v, clearance_m=2.0 - k / len(p_world),
                contact="", armed=True, battery_fraction=1.0,
            )
        )  # fmt: skip
        tracks.heard(
            topics.ODOMETRY,
            Odometry(
                stamp_ns=stamp_ns,
                p_odom=rotate(q_turn, (p - p_world[0]) * scale) + offset,
                q_odom_body=quaternion_multiply(q_turn, q),
                v_odom=v, omega_body=np.zeros(3), pose_variance=np.ones(6), velocity_variance=np.ones(3),
                measured_ns=stamp_ns, quality=1.0, reset_counter=0,
            ),
        )  # fmt: skip
    return tracks


def smoothed(stamp_ns, q_map_odom):
    return SmoothedState(
        stamp_ns=stamp_ns, p_map=np.zeros(3), q_map_body=np.array([1.0, 0, 0, 0]), v_map=np.zeros(3),
        gyro_bias_body=np.zeros(3), accel_bias_body=np.zeros(3), p_map_odom=np.zeros(3), q_map_odom=q_map_odom,
        pose_variance=np.ones(6), factors=1,
    )  # fmt: skip


def line(length_m, n=3000):
    return np.column_stack([np.linspace(0, length_m, n), np.zeros(n), np.full(n, 2.0)])


def both(tracks):
    return aligned(tracks.estimated_track(), tracks.true_track())


def test_a_perfect_estimate_has_no_error_whatever_its_frame():
    figures = trajectory_figures(fly(line(120), offset_yaw=1.1, offset=(5.0, -3.0, 1.0)))
    assert figures["position_rmse_m"] == pytest.approx(0.0, abs=1e-9)
    assert figures["drift_percent"] == pytest.approx(0.0, abs=1e-9)


def test_a_tilt_that_the_graph_knows_is_no_error():
    """odom leans by 6 mrad; from 2 s on `estimation/smoothed` says so."""
    truth, leaning = fly(line(120)), Tracks()
    leaning.truth = truth.truth
    q = np.array([np.cos(0.003), 0.0, np.sin(0.003), 0.0])  # map <- odom
    for k, o in enumerate(truth.odometry):
        if k == 100:
            leaning.heard(topics.SMOOTHED, smoothed(o.stamp_ns, q))
        body = quaternion_multiply(quaternion_conjugate(q), o.q_odom_body)
        o_leaning = replace(o, p_odom=rotate(quaternion_conjugate(q), o.p_odom), q_odom_body=body)
        leaning.heard(topics.ODOMETRY, o_leaning)
    track = leaning.map_track()
    assert np.abs(track.p[100:, 2]).max() < 1e-9 and track.p[99, 2] > 0.02
    assert leaning.estimated_track().p[-1, 2] == pytest.approx(120 * 0.006, rel=1e-3)
    assert trajectory_figures(leaning)["end_error_m"] == pytest.approx(0.0, abs=1e-3)


def test_a_scale_error_of_one_percent_drifts_one_percent():
    estimate, truth = both(fly(line(200), scale=1.01))
    assert drift_percent(estimate, truth) == pytest.approx(1.0, rel=1e-2)


def test_turning_between_two_samples_of_the_truth_is_no_drift():
    t = np.arange(0.0, 60.0, 0.01)
    p = np.column_stack([4.0 * t, np.zeros(len(t)), np.full(len(t), 2.0)])
    yaw = 0.8 * np.sin(2.0 * t)
    q = np.array([quaternion_from_yaw(y) for y in yaw])
    truth = Track(t[1::2], p[1::2], q[1::2])  # turning by up to 32 mrad between samples
    assert drift_percent(Track(t, p, q), truth.at(t)) < 0.02


def test_a_short_flight_tells_its_end_error_over_its_length():
    estimate, truth = both(fly(line(20), scale=1.02))
    assert drift_percent(estimate, truth) == pytest.approx(2.0, rel=2e-2)


def test_length_speed_and_clearance():
    figures = trajectory_figures(fly(line(100, n=2001)))
    assert figures["path_length_m"] == pytest.approx(100, rel=1e-3)
    assert figures["mean_speed_m_s"] == pytest.approx(2.5, rel=1e-2)
    assert figures["min_clearance_m"] == pytest.approx(1.0, abs=1e-3)
    assert figures["duration_s"] == pytest.approx(40.0)


def test_standing_noise_adds_no_length():
    rng = np.random.default_rng(0)
    assert path_length(rng.normal(0, 0.005, (5000, 3))) < 0.1


def test_a_flight_that_never_was_has_no_figures():
    assert all(math.isnan(v) for v in trajectory_figures(Tracks()).values())
