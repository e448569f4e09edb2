"""Sensor watch: says on `why` what is wrong with IMU, LiDAR and camera. It changes nothing."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import numpy as np

from companion.core.messages import Array, Array32, CameraImage, ImuSample, LidarScan, Why
from companion.core.node import Node, Output, Topic, every, on
from companion.core.topics import CAMERA, IMU, LIDAR, WHY
from companion.sensors.guard import SensorsConfig, StreamGuard


class SensorsNode(Node):
    """One guard per stream; estimation itself drops what is unusable."""

    publishes = (WHY,)

    def __init__(self, config: SensorsConfig) -> None:
        self._config = config
        self._imu = _guard("IMU", IMU, config)
        self._lidar = _guard("LiDAR", LIDAR, config)
        self._camera = _guard("camera", CAMERA, config)

    @on(IMU)
    def imu(self, sample: ImuSample) -> Iterator[Output]:
        """Check one sample."""
        bad = max(_bad_share(sample.angular_velocity_body), _bad_share(sample.specific_force_body))
        yield from self._tell(sample.stamp_ns, self._imu.check(sample.stamp_ns, bad_share=bad))

    @on(LIDAR)
    def lidar(self, scan: LidarScan) -> Iterator[Output]:
        """Check one sweep."""
        count = len(scan.points_sensor)
        few = f"LiDAR: only {count} points in a sweep" if count < self._config.min_points else ""
        bad = _bad_share(scan.points_sensor)
        yield from self._tell(scan.stamp_ns, self._lidar.check(scan.stamp_ns, bad_share=bad, shortage=few))

    @on(CAMERA)
    def camera(self, image: CameraImage) -> Iterator[Output]:
        """Check one image."""
        dark = "camera: the image has no contrast" if int(np.ptp(image.pixels)) < 8 else ""
        yield from self._tell(image.stamp_ns, self._camera.check(image.stamp_ns, shortage=dark))

    @every(hz=4)
    def silence(self, now_ns: int) -> Iterator[Output]:
        """Look for streams that stopped."""
        for guard in (self._imu, self._lidar, self._camera):
            yield from self._tell(now_ns, guard.silence(now_ns))

    def _tell(self, stamp_ns: int, faults: list[str]) -> Iterator[Output]:
        for fault in faults:
            yield WHY(Why(stamp_ns=stamp_ns, node="SensorsNode", what="sensor fault", because=fault))


def _guard(name: str, topic: Topic[Any], config: SensorsConfig) -> StreamGuard:
    return StreamGuard(name, topic.rate_hz, config, deadline_s=topic.deadline_s or 0.0)


def _bad_share(values: Array | Array32) -> float:
    with np.errstate(invalid="ignore", over="ignore"):
        if math.isfinite(float(values.sum())):  # the rule, and quicker to see
            return 0.0
    return 1.0 - float(np.isfinite(values).mean())
