"""LiDAR odometries of others on the same sweeps, one thread each: KISS-ICP, and small_gicp's VGICP scan to map.

for name, peer in peers(max_range_m=60.0).items():
    peer.register(scan)

Both come as wheels (`pip install 'understory[bench]'`) and have no IMU: they start from constant velocity.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from time import thread_time
from typing import Any, Protocol

import numpy as np

from companion.core.messages import Array, LidarScan

WHEELS = {"kiss-icp": "kiss_icp", "small-gicp": "small_gicp"}
_KISS_VOXEL_M, _GICP_VOXEL_M, _GICP_THIN_M = 1.0, 1.0, 0.25
_MIN_RANGE_M = 0.4


class Peer(Protocol):
    """An odometry of sweeps."""

    stamps_ns: list[int]
    poses: list[Array]  # of the sensor in the frame of its first sweep, (4, 4)
    cpu_s: float

    def register(self, scan: LidarScan) -> None:
        """Take the next sweep."""


def missing() -> list[str]:
    """Peers whose wheel is not there."""
    return [name for name, module in WHEELS.items() if importlib.util.find_spec(module) is None]


def peers(*, max_range_m: float) -> dict[str, Peer]:
    """Those that are installed, fresh."""
    makers: dict[str, Callable[[float], Any]] = {"kiss-icp": _kiss_step, "small-gicp": _gicp_step}
    return {name: _Timed(make(max_range_m)) for name, make in makers.items() if name not in missing()}


class _Timed:
    """Charges each sweep's CPU time to the peer."""

    def __init__(self, step: Callable[[LidarScan], Array]) -> None:
        self._step = step
        self.stamps_ns: list[int] = []
        self.poses: list[Array] = []
        self.cpu_s = 0.0

    def register(self, scan: LidarScan) -> None:
        """Take the next sweep; what preparing the input costs is not charged."""
        if len(scan.points_sensor) < 100:
            return
        started = thread_time()
        pose = self._step(scan)
        self.cpu_s += thread_time() - started
        self.stamps_ns.append(scan.stamp_ns)
        self.poses.append(pose)


def _kiss_step(max_range_m: float) -> Callable[[LidarScan], Array]:
    from kiss_icp.config.parser import load_config
    from kiss_icp.kiss_icp import KissICP

    config = load_config(None)
    config.data.max_range, config.data.min_range, config.data.deskew = max_range_m, _MIN_RANGE_M, True
    config.mapping.voxel_size = _KISS_VOXEL_M
    config.registration.max_num_threads = 1
    odometry = KissICP(config)

    def _step(scan: LidarScan) -> Array:
        odometry.register_frame(scan.points_sensor.astype(np.float64), scan.point_age_s.max() - scan.point_age_s)
        return np.array(odometry.last_pose)

    return _step


def _gicp_step(max_range_m: float) -> Callable[[LidarScan], Array]:
    import small_gicp

    target = small_gicp.GaussianVoxelMap(_GICP_VOXEL_M)
    poses = [np.eye(4), np.eye(4)]

    def _step(scan: LidarScan) -> Array:
        near = (scan.points_sensor**2).sum(axis=1) < max_range_m**2
        cloud, _ = small_gicp.preprocess_points(
            scan.points_sensor[near].astype(np.float64), downsampling_resolution=_GICP_THIN_M, num_threads=1
        )
        if target.size():
            guess = poses[-1] @ np.linalg.inv(poses[-2]) @ poses[-1]
            found = small_gicp.align(target, cloud, guess, max_correspondence_distance=2.0, num_threads=1)
            poses.append(np.array(found.T_target_source))
        target.insert(cloud, poses[-1])
        return poses[-1]

    return _step
