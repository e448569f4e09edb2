"""Where the camera's rays meet the LiDAR's map: depth of image points from the map's planes."""

from __future__ import annotations

import numpy as np

from companion.core.messages import Array, Array32
from companion.core.rig import Rig
from companion.estimation.point_map import PointMap
from companion.estimation.registration import Flags, PlaneConfig, find_planes
from companion.estimation.state import State

_DOWNWARD, _STEEP = 0.2, 0.15  # least share of a ray that points down, and that goes across its plane
_SETTLED_M = 0.05
_ROUNDS = 4


class GroundRays:
    """Intersects rays with the map; remembers how high the ground usually is, as a first guess of depth."""

    def __init__(self, rig: Rig, *, depth_m: tuple[float, float]) -> None:
        self._R, self._p = np.ascontiguousarray(rig.camera.R_body_sensor), rig.camera.p_body
        self._intrinsics = np.array([rig.pinhole.focal_px, *rig.pinhole.center_px])
        self._nearest_m, self._farthest_m = depth_m
        self._ground_m = 0.0  # in odom

    def above_m(self, state: State) -> float:
        """How high the camera is above the ground that it usually sees; never nearer than it could see any."""
        return max(float(state.p[2] + state.R[2] @ self._p) - self._ground_m, self._nearest_m)

    def rays(self, corners: Array32, state: State) -> tuple[Array, Array]:
        """OpenCV pixels (N, 2) to the camera's position in odom (3,) and rays in odom (N, 3), 1 along the axis."""
        R, p = state.R, state.p
        f, cx, cy = self._intrinsics
        optical = np.column_stack([(corners[:, 0] + 0.5 - cx) / f, (corners[:, 1] + 0.5 - cy) / f])
        rays = np.column_stack([optical, np.ones(len(corners))]) @ (R @ self._R).T
        return p + R @ self._p, rays

    def meet(self, corners: Array32, state: State, target: PointMap, planes: PlaneConfig) -> tuple[Array, Array, Flags]:
        """Points in odom (N, 3), planes there (N, 4), and which of them are good.

        A fixed point of intersecting with the local plane: `corners` are OpenCV pixels (N, 2).
        """
        origin, rays = self.rays(corners, state)
        downward = rays[:, 2] < -_DOWNWARD
        depth = np.where(downward, (origin[2] - self._ground_m) / np.maximum(-rays[:, 2], _DOWNWARD), 0.0)
        found, valid = np.zeros((len(corners), 4)), np.zeros(len(corners), np.bool_)
        for _ in range(_ROUNDS):
            at = origin + rays * depth[:, None]
            find_planes(target, at, np.eye(3), np.zeros(3), planes, found, valid)
            across = (found[:, :3] * rays).sum(axis=1)
            usable = valid & downward & (np.abs(across) > _STEEP)
            hit = -(found[:, :3] @ origin + found[:, 3]) / np.where(usable, across, 1.0)
            usable &= (hit > self._nearest_m) & (hit < self._farthest_m)
            settled = usable & (np.abs(hit - depth) < _SETTLED_M)
            depth = np.where(usable, hit, depth)
        anchors = origin + rays * depth[:, None]
        if settled.sum() > 5:
            self._ground_m = float(np.median(anchors[settled, 2]))
        return anchors, found, settled
