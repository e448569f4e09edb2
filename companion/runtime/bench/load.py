"""The full load of a vehicle's bus: what is said, and how often."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from companion.core import messages as m
from companion.core import topics
from companion.core.node import Topic

RETURNS, MISSES = 30_000, 7_449  # 28 bytes each on the bus: 1 MB
IMAGE = (480, 640)
CELLS = (68, 68, 25)  # 9 bytes each: 1 MB
PATH_POINTS = 100


@dataclass(frozen=True, slots=True)
class Stream:
    """One topic with its rate; `make` gives a message of the stamp."""

    topic: Topic[Any]
    rate_hz: float
    make: Callable[[int], Any]


def full_load(seed: int = 0) -> tuple[Stream, ...]:
    """IMU 200, odometry 200, setpoint 50, image 15, cloud 10 x 1 MB, path 5, map 2 x 1 MB per second."""
    rng = np.random.default_rng(seed)
    return (
        _stream(topics.IMU, 200.0, _imu(rng)),
        _stream(topics.ODOMETRY, 200.0, _odometry(rng)),
        _stream(topics.SETPOINT, 50.0, _setpoint(rng)),
        _stream(topics.CAMERA, 15.0, m.CameraImage(stamp_ns=0, pixels=rng.integers(0, 255, IMAGE, np.uint8))),
        _stream(topics.LIDAR, 10.0, cloud(RETURNS, MISSES, rng)),
        _stream(topics.TRAJECTORY, 5.0, _path(rng)),
        _stream(topics.LOCAL_MAP, 2.0, _map(rng)),
    )


def cloud(returns: int, misses: int, rng: np.random.Generator) -> m.LidarScan:
    """A sweep of a tenth of a second."""
    dirs = rng.normal(size=(misses, 3)).astype(np.float32)
    return m.LidarScan(
        stamp_ns=0,
        points_sensor=rng.uniform(-40, 40, (returns, 3)).astype(np.float32),
        point_age_s=np.linspace(0.1, 0, returns, dtype=np.float32),
        miss_dirs_sensor=dirs / np.linalg.norm(dirs, axis=1, keepdims=True),
        miss_age_s=np.linspace(0.1, 0, misses, dtype=np.float32),
    )


def _stream(topic: Topic[Any], rate_hz: float, message: Any) -> Stream:
    m.freeze(message)
    return Stream(topic, rate_hz, lambda stamp_ns: replace(message, stamp_ns=stamp_ns))


def _imu(rng: np.random.Generator) -> m.ImuSample:
    return m.ImuSample(stamp_ns=0, angular_velocity_body=rng.normal(size=3), specific_force_body=rng.normal(size=3))


def _odometry(rng: np.random.Generator) -> m.Odometry:
    return m.Odometry(
        stamp_ns=0,
        p_odom=rng.normal(size=3),
        q_odom_body=np.array([1.0, 0.0, 0.0, 0.0]),
        v_odom=rng.normal(size=3),
        omega_body=rng.normal(size=3),
        pose_variance=rng.uniform(0, 1, 6),
        velocity_variance=rng.uniform(0, 1, 3),
        measured_ns=0,
        quality=0.9,
        reset_counter=0,
    )


def _setpoint(rng: np.random.Generator) -> m.Setpoint:
    p, v, a = rng.normal(size=(3, 3))
    return m.Setpoint(stamp_ns=0, p_odom=p, v_odom=v, a_odom=a, yaw=0.1, yaw_rate=0.0)


def _path(rng: np.random.Generator) -> m.Trajectory:
    return m.Trajectory(
        stamp_ns=0,
        goal_id=1,
        p_odom=rng.normal(size=(PATH_POINTS, 3)).cumsum(axis=0),
        speed=np.ones(PATH_POINTS),
        accel_limit=2.0,
        yaw=0.0,
        yaw_rate_limit=1.0,
    )


def _map(rng: np.random.Generator) -> m.LocalMap:
    return m.LocalMap(
        stamp_ns=0,
        origin_odom=np.zeros(3),
        resolution_m=0.2,
        state=rng.integers(0, 3, CELLS, np.uint8),
        distance_m=rng.uniform(0, 5, CELLS).astype(np.float32),
        unknown_distance_m=rng.uniform(0, 5, CELLS).astype(np.float32),
        ground_z_odom=np.zeros(CELLS[:2], np.float32),
    )
