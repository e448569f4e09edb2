"""Readers on small made-up recordings, and on the real ones where they are at hand."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from companion.core.errors import InputError
from companion.runtime.odometry_run import run_odometry
from companion.runtime.recordings import open_recording
from companion.runtime.trajectory_error import align, track_error

DATA = Path(__file__).resolve().parents[4] / "shared" / "data"
needs_data = pytest.mark.skipif(not DATA.is_dir(), reason="the real recordings are not here")
ANGLES = "; ".join(str(a) for a in (-10.0, 0.0, 30.0))


def durlacher_like(path, scans=3):
    (path / "img.cfg").write_text(f"# comment\n4; 3; 180; -180; {ANGLES}")
    rows = ["scans - IMU File", "", ";;GPS", "timestamp;..."]
    for k in range(scans):
        position = f"{10 + k};{20 + 2 * k};5"
        rows.append(f"2010-03-11 13:49:14.{100 * k + 5:03d}000001;5;49;8;99;0;0;0;0;0;0;0;0;0;{position};")
        cv2.imwrite(str(path / f"scan{k:05d}.png"), np.full((3, 4), 1000 + k, np.uint16))
    (path / "imu.cfg").write_text("\n".join(rows) + "\n")
    mask = np.full((3, 4), 255, np.uint8)
    mask[0, 0] = 0
    cv2.imwrite(str(path / "mask.png"), mask)


def test_range_images_become_points_in_time_order(tmp_path):
    durlacher_like(tmp_path)
    recording = open_recording(tmp_path)
    scans = list(recording.scans())
    assert recording.scan_count == len(scans) == 3
    first = scans[0]
    assert len(first.points_sensor) == 11  # one pixel is masked
    np.testing.assert_allclose(np.linalg.norm(first.points_sensor, axis=1), 2.0, rtol=1e-6)
    # Row 1 is level; its columns look back left, left, right, back right: 135, 45, -45, -135 deg.
    level = first.points_sensor[3:7]
    np.testing.assert_allclose(np.degrees(np.arctan2(level[:, 1], level[:, 0])), [135, 45, -45, -135], atol=1e-4)
    np.testing.assert_allclose(np.degrees(np.arcsin(first.points_sensor[0, 2] / 2)), 10, atol=1e-4)
    np.testing.assert_allclose(first.point_age_s[3:7], np.array([0.875, 0.625, 0.375, 0.125]) * 0.1, rtol=1e-5)
    assert scans[1].stamp_ns - first.stamp_ns == 100_000_000
    assert first.stamp_ns % 10**9 == 5_000_001 + 100_000_000
    np.testing.assert_allclose(recording.reference.p, [[0, 0, 0], [1, 2, 0], [2, 4, 0]])


def test_sweeps_with_start_and_end_stamps(tmp_path):
    folder = tmp_path / "velodyne_dist"
    (folder / "data").mkdir(parents=True)
    (folder / "velodyne_config.txt").write_text("500 4 3 180 -180 " + ANGLES.replace(";", ""))
    cv2.imwrite(str(folder / "data" / "0000000000.png"), np.full((3, 4), 500, np.uint16))
    (folder / "timestamps_start.txt").write_text("2011-07-14 13:52:31.348051570\n")
    (folder / "timestamps_end.txt").write_text("2011-07-14 13:52:31.452298312\n")
    (scan,) = open_recording(tmp_path).scans()
    assert scan.stamp_ns % 10**9 == 452_298_312
    assert scan.point_age_s.max() == pytest.approx(0.875 * 0.104246742, rel=1e-6)


def test_archives_with_a_time_per_point(tmp_path):
    names = ["17_900000000", "18_50000000"]  # as text the other way round
    arrays = {}
    for name in names:
        arrays[f"{name}_xyz"] = np.ones((2, 3), np.float32)
        arrays[f"{name}_t"] = np.array([0.0, 9e7])
    np.savez(tmp_path / "scans.npz", **arrays)
    head = "header.stamp.sec,header.stamp.nanosec," + ",".join(f"pose.pose.position.{a}" for a in "xyz")
    (tmp_path / "trajectory.csv").write_text(head + "\n17,900000000,1,2,3\n18,50000000,2,2,3\n")
    recording = open_recording(tmp_path)
    scans = list(recording.scans())
    assert [s.stamp_ns for s in scans] == [18_000_000_000, 18_150_000_000]
    np.testing.assert_allclose(scans[0].point_age_s, [0.1, 0.01], rtol=1e-6)
    np.testing.assert_array_equal(recording.reference.p, [[0, 0, 0], [1, 0, 0]])


def test_what_is_no_recording_is_said_so(tmp_path):
    with pytest.raises(InputError, match="no such folder"):
        open_recording(tmp_path / "nothing")
    (tmp_path / "DurlacherTor").mkdir()
    with pytest.raises(InputError, match=r"did you mean one of its folders DurlacherTor\?"):
        open_recording(tmp_path)
    durlacher_like(tmp_path / "DurlacherTor")
    (tmp_path / "DurlacherTor" / "scan00002.png").write_bytes(b"not an image")
    with pytest.raises(InputError, match="not a readable image"):
        list(open_recording(tmp_path / "DurlacherTor").scans())
    (tmp_path / "DurlacherTor" / "scan00002.png").unlink()
    with pytest.raises(InputError, match="3 rows for 2 images"):
        open_recording(tmp_path / "DurlacherTor")


def test_alignment_undoes_any_rigid_motion():
    rng = np.random.default_rng(0)
    p = rng.normal(size=(50, 3))
    Q = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    Q *= np.sign(np.linalg.det(Q))
    np.testing.assert_allclose(align(p, p @ Q.T + [1, 2, 3]), p @ Q.T + [1, 2, 3], atol=1e-12)
    mirrored = p * [1, 1, -1]
    assert np.abs(align(p, mirrored) - mirrored).max() > 0.1  # a mirror image is no motion


def test_track_error_of_a_known_error():
    t = np.arange(100) * 100_000_000 + 1_700_000_000_000_000_000
    p = np.column_stack([np.linspace(0, 50, 100), np.sin(np.arange(100) / 9), np.zeros(100)])
    bent = p + np.array([0, 0, 1.0]) * np.sin(np.arange(100) / 3)[:, None]
    flat = track_error(t, bent, t, p, flat=True)
    assert flat.ate_m == pytest.approx(0, abs=1e-9)
    assert flat.length_m == pytest.approx(np.linalg.norm(np.diff(p[:, :2], axis=0), axis=1).sum())
    full = track_error(t, bent, t, p, flat=False)
    assert full.ate_m == pytest.approx(0.7, abs=0.05)
    assert full.compared == 100
    shifted = track_error(t + 10**12, p, t, p, flat=False)
    assert shifted is None


@needs_data
def test_real_street_against_ins(tmp_path):
    seen = []
    report = run_odometry(DATA / "lidar_moosmann_hdl64" / "DurlacherTor", out=tmp_path, on_registered=seen.append)
    assert len(seen) == len(report.stamps_ns) == 52
    assert report.error.ate_flat_m < 0.2
    assert report.error.length_m > 15
    rows = np.loadtxt(tmp_path / "trajectory.csv")
    assert rows.shape == (52, 8)
    np.testing.assert_allclose(rows[:, 1:4], report.p_odom, atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(rows[:, 4:], axis=1), 1, atol=1e-5)
    assert (tmp_path / "trajectory.png").read_bytes().startswith(b"\x89PNG")


@needs_data
def test_real_robot_that_hardly_moves():
    report = run_odometry(DATA / "lidar_norlab_pertime")
    assert len(report.stamps_ns) == 14
    assert report.error.ate_m < 0.02
    assert report.inlier_fraction > 0.4


@needs_data
@pytest.mark.slow
def test_real_drive_has_the_length_that_vgicp_found():
    report = run_odometry(DATA / "lidar_moosmann_hdl64" / "MuehlburgerTor")
    assert len(report.stamps_ns) == 501
    assert report.path_length_m == pytest.approx(report.reference_length_m, rel=0.02)
