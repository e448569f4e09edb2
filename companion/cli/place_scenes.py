"""Sweeps along ways through simulated worlds, for the bench of places: the truth, and what odometry makes of it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter1d

from companion.core.geometry import exp_so3, quaternion_from_rotation, quaternion_from_yaw, rotation_from_quaternion
from companion.core.messages import Array, Array32, RegisteredScan
from companion.core.rig import Rig
from sim.sensors.camera import CameraConfig
from sim.sensors.lidar import LidarConfig
from sim.sensors.scene import RenderSetup, Sensors
from sim.world import World

SWEEP_NS = 100_000_000


@dataclass(frozen=True, slots=True, eq=False)
class Way:
    """True poses, one per sweep: p (N, 3), m, world, and yaw (N,), rad."""

    p: Array
    yaw: Array


def way_through(world: World, corners: Array, *, spacing_m: float, agl_m: float) -> Way:
    """A way with rounded corners through points (K, 2), facing ahead, so high above ground."""
    corners = np.asarray(corners, np.float64)
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(corners, axis=0), axis=1))])
    s = np.arange(0.0, along[-1], spacing_m)
    xy, ahead, behind = (_at(corners, along, s + shift) for shift in (0.0, 0.6, -0.6))
    yaw = np.unwrap(np.arctan2(*(ahead - behind).T[::-1]))
    xy, yaw = gaussian_filter1d(xy, 2, axis=0, mode="nearest"), gaussian_filter1d(yaw, 2, mode="nearest")
    return Way(np.column_stack([xy, world.ground_z(xy[:, 0], xy[:, 1]) + agl_m]), yaw)


def _at(corners: Array, along: Array, s: Array) -> Array:
    return np.stack([np.interp(s, along, corners[:, k]) for k in range(2)], axis=1)


def way_length(way: Way) -> float:
    """In m."""
    return float(np.linalg.norm(np.diff(way.p, axis=0), axis=1).sum())


class Eye:
    """The LiDAR of the simulated vehicle, held still at each pose: sweeps need no motion compensation."""

    def __init__(self, world: World, *, seed: int) -> None:
        self._rig = Rig()
        setup = RenderSetup(world.mesh, LidarConfig(), CameraConfig(), self._rig, seed, world.walkers, world.air)
        self._sensors = Sensors(setup)

    def sweep(self, p_world: Array, yaw: float, counter: int) -> tuple[Array32, Array32]:
        """Points (N, 3) and directions of misses (M, 3), in the body."""
        q = np.tile(quaternion_from_yaw(yaw), (2, 1))
        request = {"p_world": np.tile(p_world, (2, 1)), "q_world_body": q, "counter": counter}
        scan, _ = self._sensors.render("lidar", {**request, "stamp_ns": (counter + 1) * SWEEP_NS})
        R = self._rig.lidar.R_body_sensor.astype(np.float32)
        points = scan.points_sensor @ R.T + self._rig.lidar.p_body.astype(np.float32)  # type: ignore[union-attr]
        return np.ascontiguousarray(points), np.ascontiguousarray(scan.miss_dirs_sensor @ R.T)  # type: ignore[union-attr]

    def registered(self, way: Way, poses: tuple[list[Array], Array]) -> Iterator[RegisteredScan]:
        """A message per pose of the way, with the poses (R, p) that odometry gives it."""
        for k in range(len(way.p)):
            points, misses = self.sweep(way.p[k], float(way.yaw[k]), k)
            yield RegisteredScan(
                stamp_ns=(k + 1) * SWEEP_NS,
                points_body=points,
                miss_dirs_body=misses,
                origin_body=self._rig.lidar.p_body,
                p_odom=poses[1][k],
                q_odom_body=quaternion_from_rotation(poses[0][k]),
            )


def true_poses(way: Way) -> tuple[list[Array], Array]:
    """R (N, 3, 3) and p (N, 3) of odometry that does not drift."""
    return [rotation_from_quaternion(quaternion_from_yaw(float(y))) for y in way.yaw], way.p


def drifting_poses(
    way: Way, *, yaw_per_m: float, scale: float, climb_per_m: float, seed: int
) -> tuple[list[Array], Array]:
    """The poses of odometry that errs a little with each metre: heading, scale, height, and noise of 1 mm a step."""
    R_true, p_true = true_poses(way)
    R, p = [R_true[0]], [p_true[0]]
    for k in range(len(p_true) - 1):
        step = R_true[k].T @ (p_true[k + 1] - p_true[k])
        way_m = float(np.linalg.norm(step))
        p.append(p[-1] + R[-1] @ (scale * step) + np.array([0.0, 0.0, climb_per_m * way_m]))
        R.append(R[-1] @ R_true[k].T @ R_true[k + 1] @ exp_so3(np.array([0.0, 0.0, yaw_per_m * way_m])))
    noise = np.random.default_rng(seed).normal(0.0, 1e-3, (len(p), 3))
    return R, np.array(p) + np.cumsum(noise, axis=0)
