"""Odometry from sweeps alone, on a synthetic drive with motion distortion."""

import msgspec
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from companion.core.messages import LidarScan
from companion.core.rig import Mount, Rig
from companion.estimation.deskew import ScanGate
from companion.estimation.lidar_only import LidarOdometry, LidarOnlyConfig
from companion.estimation.point_map import PointMapConfig
from companion.estimation.registration import PlaneConfig
from tests.unit.estimation.synthetic import record

RIG = Rig(lidar=Mount())
CONFIG = LidarOnlyConfig(
    gate=ScanGate(hull_half_m=(0.0, 0.0, 0.0)),
    map=PointMapConfig(),
    plane=PlaneConfig(breadth_m=0.08),
    thin_m=0.4,
)


@pytest.fixture(scope="module")
def drive():
    truth, events = record(9.0, rig=RIG)
    return truth, [m for _, m in events if isinstance(m, LidarScan)]


def follow(scans, config=CONFIG):
    odometry = LidarOdometry(config)
    registered = [odometry.register(s) for s in scans]
    return np.array([r.p_odom for r in registered]), registered


def off(truth, scans, p):
    q = truth.pose(np.array([s.stamp_ns for s in scans]) * 1e-9)[1]
    R, _ = Rotation.align_vectors(q - q.mean(axis=0), p - p.mean(axis=0))
    return np.linalg.norm(R.apply(p - p.mean(axis=0)) + q.mean(axis=0) - q, axis=1)


def test_it_follows_the_drive(drive):
    truth, scans = drive
    p, registered = follow(scans)
    length = np.linalg.norm(np.diff(truth.p, axis=0), axis=1).sum()
    assert length > 15
    assert np.sqrt((off(truth, scans, p) ** 2).mean()) < 0.05
    assert [r.stamp_ns for r in registered] == [s.stamp_ns for s in scans]
    assert not p[0].any()


def test_deskewing_pays(drive):
    truth, scans = drive
    torn = [
        LidarScan(
            stamp_ns=s.stamp_ns,
            points_sensor=s.points_sensor,
            point_age_s=np.zeros_like(s.point_age_s),
            miss_dirs_sensor=s.miss_dirs_sensor,
            miss_age_s=s.miss_age_s,
        )
        for s in scans
    ]
    with_it, without = (np.sqrt((off(truth, scans, follow(s)[0]) ** 2).mean()) for s in (scans, torn))
    assert with_it < 0.7 * without


def test_neighbours_on_a_line_hold_the_scan_where_it_is(drive):
    """The rings of a sweep on the ground travel with the sensor; taken for planes they stop it."""
    truth, scans = drive
    lines = msgspec.structs.replace(CONFIG, plane=PlaneConfig(breadth_m=0.0))
    p, _ = follow(scans, lines)
    assert np.sqrt((off(truth, scans, p) ** 2).mean()) > 0.3


def test_empty_sweeps_and_equal_stamps_are_survived(drive):
    _, scans = drive
    none = LidarScan(
        stamp_ns=scans[1].stamp_ns,
        points_sensor=np.empty((0, 3), np.float32),
        point_age_s=np.empty(0, np.float32),
        miss_dirs_sensor=np.empty((0, 3), np.float32),
        miss_age_s=np.empty(0, np.float32),
    )
    p, _ = follow([none, scans[0], none, scans[1], scans[1], scans[2]])
    assert np.linalg.norm(p, axis=1).max() < 0.1  # it stands
