"""LiDAR odometry without an IMU: constant body twist between sweeps, planes against a growing map.

    odometry = LidarOdometry(LidarOnlyConfig())
    for scan in scans:
        registered = odometry.register(scan)      # RegisteredScan in odom, the first sensor frame

The role of KISS-ICP (I. Vizzo et al., RA-L 2023), with the front end's own kernels.
"""

from __future__ import annotations

from typing import Annotated

import msgspec
import numpy as np

from companion.core.geometry import exp_so3, log_so3, quaternion_from_rotation
from companion.core.messages import Array, Array32, LidarScan, RegisteredScan
from companion.estimation.deskew import ScanGate, constant_twist_nodes, deskew_directions, deskew_points
from companion.estimation.downsample import Thinner
from companion.estimation.point_map import PointMap, PointMapConfig
from companion.estimation.registration import PlaneConfig, PlaneRegistration
from companion.estimation.so3 import orthonormal

Positive = Annotated[float, msgspec.Meta(gt=0)]
Count = Annotated[int, msgspec.Meta(ge=1)]


class LidarOnlyConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Defaults fit a car with a 64-beam LiDAR in a street."""

    gate: ScanGate = ScanGate(min_range_m=2.5, max_range_m=80.0, hull_half_m=(0.0, 0.0, 0.0))
    map: PointMapConfig = PointMapConfig(voxel_m=0.8, spacing_m=0.2)
    plane: PlaneConfig = PlaneConfig(neighbour_m=2.0, breadth_m=0.08)
    thin_m: Positive = 0.8  # one point per voxel of this edge is registered
    points: Count = 3000  # and at most so many
    coarse_sigma_m: Positive = 0.2  # of a point against its plane in the first pass: no IMU guides it
    passes: Count = 2  # deskewing with the motion that the pass before found
    iterations: Count = 8  # Gauss-Newton, per pass
    accel_m_s2: Positive = 4.0  # sigma of what breaks the constant velocity
    angular_accel_rad_s2: Positive = 1.5
    min_planes: Annotated[int, msgspec.Meta(ge=6)] = 50


class LidarOdometry:
    """Pose of the sensor at the end of each sweep, in the frame of the first one."""

    def __init__(self, config: LidarOnlyConfig) -> None:
        self.config = config
        self.map = PointMap(config.map)
        self.R, self.p = np.eye(3), np.zeros(3)
        self.inlier_fraction = 0.0
        self._omega, self._v = np.zeros(3), np.zeros(3)  # body twist
        self._stamp_ns: int | None = None
        self._thinner = Thinner()

    def register(self, scan: LidarScan) -> RegisteredScan:
        """Take the next sweep; its stamp must be newer than the last one's."""
        before = self.R, self.p
        dt = 0.1 if self._stamp_ns is None else max((scan.stamp_ns - self._stamp_ns) * 1e-9, 1e-3)
        self._stamp_ns = scan.stamp_ns
        if not self.map.voxels:
            nodes, points = self._deskew(scan)
        else:
            self._predict(dt)
            predicted = self.R, self.p
            for k in range(self.config.passes):
                nodes, points = self._deskew(scan)
                self._fit(points, predicted, dt, is_coarse=k == 0)
                self._set_twist(before, dt)
        self.map.insert(self._thinner.firsts(points, self.config.map.spacing_m), self.R, self.p)
        return self._message(scan, points, nodes)

    def _predict(self, dt: float) -> None:
        half = exp_so3(self._omega * dt / 2)
        self.p = self.p + self.R @ half @ self._v * dt
        self.R = orthonormal(self.R @ half @ half)

    def _set_twist(self, before: tuple[Array, Array], dt: float) -> None:
        turn = log_so3(before[0].T @ self.R)
        middle = before[0] @ exp_so3(turn / 2)
        self._omega, self._v = turn / dt, middle.T @ (self.p - before[1]) / dt

    def _deskew(self, scan: LidarScan) -> tuple[Array, Array32]:
        t_s = 0.0
        nodes = constant_twist_nodes(
            self.R, self.p, self._omega, self._v, t_end_s=t_s, duration_s=self.config.gate.max_age_s
        )
        points = deskew_points(
            scan.points_sensor,
            scan.point_age_s,
            nodes,
            pose_end=(self.R, self.p),
            t_end_s=t_s,
            mount=(np.eye(3), np.zeros(3)),
            gate=self.config.gate,
        )
        return nodes, points

    def _fit(self, points_body: Array32, predicted: tuple[Array, Array], dt: float, *, is_coarse: bool) -> None:
        """Gauss-Newton on planes and on the prior that the twist hardly changes."""
        c = self.config
        few = self._thinner.centroids(points_body, c.thin_m, at_most=c.points)
        sigma_m = c.coarse_sigma_m if is_coarse else c.plane.sigma_m
        plane = msgspec.structs.replace(c.plane, sigma_m=sigma_m)
        scan = PlaneRegistration(self.map, few, plane)
        sigmas = np.repeat([c.angular_accel_rad_s2, c.accel_m_s2], 3) * dt * dt
        prior = np.diag(sigmas**-2)
        for _ in range(c.iterations):
            normal = scan.linearise(self.R, self.p)
            self.inlier_fraction = normal.used / max(normal.offered, 1)
            if normal.used < c.min_planes:
                return
            off = np.concatenate([log_so3(predicted[0].T @ self.R), self.p - predicted[1]])
            step = np.linalg.solve(normal.H + prior, normal.g - prior @ off)
            self.R = orthonormal(self.R @ exp_so3(step[:3]))
            self.p = self.p + step[3:]
            if np.linalg.norm(step[:3]) < 1e-4 and np.linalg.norm(step[3:]) < 1e-3:
                return

    def _message(self, scan: LidarScan, points: Array32, nodes: Array) -> RegisteredScan:
        misses = deskew_directions(
            scan.miss_dirs_sensor,
            scan.miss_age_s,
            nodes,
            R_end=self.R,
            t_end_s=0.0,
            R_body_sensor=np.eye(3),
        )
        return RegisteredScan(
            stamp_ns=scan.stamp_ns,
            points_body=points,
            miss_dirs_body=misses,
            origin_body=np.zeros(3),
            p_odom=self.p.copy(),
            q_odom_body=quaternion_from_rotation(self.R),
        )
