import numpy as np
import pytest

from companion.core.messages import CameraImage, ImuSample, LidarScan
from companion.core.topics import CAMERA, IMU, LIDAR
from companion.sensors.guard import SensorsConfig, StreamGuard
from companion.sensors.node import SensorsNode

MS = 1_000_000


def sample(stamp_ns, force=9.8):
    return ImuSample(
        stamp_ns=stamp_ns,
        angular_velocity_body=np.zeros(3),
        specific_force_body=np.array([0.0, 0.0, force]),
    )


def scan(stamp_ns, points):
    return LidarScan(
        stamp_ns=stamp_ns,
        points_sensor=points.astype(np.float32),
        point_age_s=np.zeros(len(points), np.float32),
        miss_dirs_sensor=np.empty((0, 3), np.float32),
        miss_age_s=np.empty(0, np.float32),
    )


def because(outputs):
    return [o.message.because for o in outputs]


def test_a_steady_stream_has_no_fault():
    guard = StreamGuard("IMU", 200.0, SensorsConfig())
    assert all(not guard.check(k * 5 * MS) for k in range(1000))
    assert guard.faults == 0
    assert guard.silence(1000 * 5 * MS) == []


@pytest.mark.parametrize(
    ("stamps", "text"),
    [
        ((0, 5, 5), "IMU: stamp 0.000 s behind the one before"),
        ((0, 5, 2), "IMU: stamp 0.003 s behind the one before"),
        ((0, 5, 105), "IMU: nothing for 0.100 s"),
    ],
)
def test_order_and_gaps(stamps, text):
    guard = StreamGuard("IMU", 200.0, SensorsConfig())
    assert [f for s in stamps for f in guard.check(s * MS)] == [text]


def test_a_backward_stamp_does_not_move_the_reference():
    guard = StreamGuard("IMU", 200.0, SensorsConfig(repeat_s=1e-9))
    faults = [bool(guard.check(s * MS)) for s in (0, 5, 1, 10, 15)]
    assert faults == [False, False, True, False, False]


def test_a_fault_is_told_once_per_repeat_time_but_always_counted():
    guard = StreamGuard("IMU", 200.0, SensorsConfig(repeat_s=1.0))
    told = sum(len(guard.check(k * 50 * MS)) for k in range(60))  # 20 Hz instead of 200
    assert told == 3
    assert guard.faults == 59


def test_node_tells_nan_shortage_darkness_and_silence():
    node = SensorsNode(SensorsConfig())
    assert because(node.handle(IMU, sample(0))) == []
    assert because(node.handle(IMU, sample(5 * MS, np.nan))) == ["IMU: 33 % of the values are not finite"]
    assert because(node.handle(LIDAR, scan(0, np.ones((5, 3))))) == ["LiDAR: only 5 points in a sweep"]
    good = np.ones((500, 3))
    assert because(node.handle(LIDAR, scan(100 * MS, good))) == []
    good[:50] = np.inf
    told = because(node.handle(LIDAR, scan(200 * MS, good)))
    assert told == ["LiDAR: 10 % of the values are not finite"]
    dark = CameraImage(stamp_ns=0, pixels=np.full((4, 4), 7, np.uint8))
    assert because(node.handle(CAMERA, dark)) == ["camera: the image has no contrast"]
    assert because(node.tick("silence", 200 * MS)) == ["IMU: silent since 0.20 s"]
    assert because(node.tick("silence", 1000 * MS)) == [
        "LiDAR: silent since 0.80 s",
        "camera: silent since 1.00 s",
    ]


def test_an_empty_sweep_is_a_shortage_and_no_crash():
    node = SensorsNode(SensorsConfig())
    assert because(node.handle(LIDAR, scan(0, np.empty((0, 3))))) == ["LiDAR: only 0 points in a sweep"]
