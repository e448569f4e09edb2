"""The downward camera, direct: patches of the ground on the LiDAR's surface, aligned by their grey levels.

Where `CameraTracker` follows corners from image to image, here every image is compared with the picture that a patch
had when it was first seen, so that nothing adds up while it is in view; and the pose itself is what is moved until
they fit. Sources: J. Engel et al., "Direct sparse odometry", PAMI 2018; C. Forster et al., "SVO", T-RO 2017.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import cv2
import numpy as np
from numpy.typing import NDArray

from companion.core.geometry import exp_so3, log_so3
from companion.core.messages import Array, Array32, Bytes2D
from companion.core.rig import Rig
from companion.estimation.camera import CameraConfig
from companion.estimation.filter import Filter
from companion.estimation.ground_rays import GroundRays
from companion.estimation.image_gate import ImageGate
from companion.estimation.normal import Normal
from companion.estimation.patches import cut, no_patches, pyramid
from companion.estimation.photometric import FOUND, MISSED, SHARED, eliminate, linearise
from companion.estimation.point_map import PointMap
from companion.estimation.registration import PlaneConfig
from companion.estimation.state import State


class DirectCamera:
    """Patches (picture, place in odom) of the images before; the same interface as `CameraTracker`.

    `lidar_hold`: `Normal.weakest` of the newest sweep, 0 while there is none. Patches lie where the pose had them, so
    they are as wrong as it was: against a LiDAR that holds every axis they must not insist.
    """

    def __init__(self, config: CameraConfig, rig: Rig, lidar_hold: Callable[[], float]) -> None:
        self.config, self._direct, self._lidar_hold = config, config.direct, lidar_hold
        self._inflation = config.direct.inflation
        self._sigma_ground = np.array([config.direct.sigma_height_m, *2 * [config.direct.sigma_slope]])
        self._mount = (np.ascontiguousarray(rig.camera.R_body_sensor), rig.camera.p_body)
        self._intrinsics = np.array([rig.pinhole.focal_px, *rig.pinhole.center_px])
        self._ground = GroundRays(rig, depth_m=(config.min_depth_m, config.max_depth_m))
        self._gate = ImageGate(config.image)
        self._bad_images = 0  # in a row
        self._seen = (0.0, np.zeros(3), np.zeros(3))  # time, position and velocity in odom at the last image
        self.forget()
        self.objection = ""  # to the last image
        self.renewed = 0.0  # share of the patches that the last image began

    def update(self, pixels: Bytes2D, filter_: Filter, target: PointMap, planes: PlaneConfig) -> Normal | None:
        """Correct the filter with an image of its own time; None if too few patches were found in it."""
        self.renewed, normal = 0.0, None
        self.objection = self._gate.objection(pixels)
        if self.objection:
            self._outlive()
            return None
        self._bad_images = 0
        self._inflation = self._direct.inflation * (1.0 + (self._lidar_hold() / self._direct.yield_above) ** 2)
        images = pyramid(pixels, self._direct.levels, self._direct.smooth_px)
        least = max(self._direct.min_patches, round(self._direct.min_share * len(self._patches)))
        if len(self._patches) >= least:
            normal = self._correct(images, filter_, least)
        self._seen = (filter_.t_s, filter_.state.p.copy(), filter_.state.v.copy())
        if len(self._patches) < self._direct.refill_below:
            self._refill(pixels, images, filter_, target, planes)
        return normal if normal is not None and normal.used >= least else None

    def above_m(self, state: State) -> float:
        """Height above the ground in view."""
        return self._ground.above_m(state)

    def forget(self) -> None:
        """Drop all patches: the next image begins new ones."""
        self._patches = no_patches(self._direct.levels, self._direct.half_px)

    def _outlive(self) -> None:
        self._bad_images += 1
        if self._bad_images > self._direct.keep_images:
            self.forget()

    def _correct(self, images: list[Array32], filter_: Filter, least: int) -> Normal:
        c = self._direct
        gates = iter([c.first_gate])
        fate = np.zeros(len(self._patches), np.int8)

        def finest(R: Array, p: Array) -> Normal:
            return self._linearise(images, 0, (R, p), next(gates, c.gate), fate)

        begin = self._coarse(images, filter_, least)
        normal = filter_.update(finest, iterations=c.iterations, at_least=least, begin=begin)
        self._patches.misses = np.where(fate == FOUND, 0.0, self._patches.misses + 1.0)
        alive = (fate == FOUND) | ((fate == MISSED) & (self._patches.misses < c.misses))
        self._patches = self._patches.only(alive)
        return normal

    def _coarse(self, images: list[Array32], filter_: Filter, least: int) -> tuple[Array, Array]:
        """Where the finest level begins: within a pixel or two, if the patches are known from one of the starts."""
        for p in self._starts(filter_):
            begin, found = self._descend(images, filter_, p)
            if found >= least:
                return begin
        return filter_.state.R.copy(), filter_.state.p.copy()

    def _starts(self, filter_: Filter) -> Iterator[Array]:
        """Positions in odom: the prior's, and straight on from the last image, should a sweep have moved it far."""
        yield filter_.state.p.copy()
        t_s, p, v = self._seen
        yield p + v * (filter_.t_s - t_s)

    def _descend(self, images: list[Array32], filter_: Filter, p: Array) -> tuple[tuple[Array, Array], int]:
        """One step at each coarser level; the pose, and how many patches the last of them found."""
        R, state = filter_.state.R.copy(), filter_.state
        prior = np.linalg.inv(filter_.P[:6, :6])
        fate = np.zeros(len(self._patches), np.int8)
        found = 0
        for level in range(len(images) - 1, 0, -1):
            normal = self._linearise(images, level, (R, p), self._direct.first_gate, fate)
            found = normal.used
            if found >= self._direct.min_patches:
                off = np.concatenate([log_so3(state.R.T @ R), p - state.p])
                step = np.linalg.solve(prior + normal.H, normal.g - prior @ off)
                R, p = R @ exp_so3(step[:3]), p + step[3:]
        return (R, p), found

    def _linearise(
        self, images: list[Array32], level: int, pose: tuple[Array, Array], gate: float, fate: NDArray[np.int8]
    ) -> Normal:
        H, g = np.empty((SHARED, SHARED)), np.empty(SHARED)
        c = self._direct
        grey = (c.sigma_grey, c.correlated_px, c.min_correlation, float((2 * c.half_px + 1) ** 2))
        floor = (c.sigma_px * 4.0**level) ** 2  # far from the solution robust weights must not let go of all
        trust = (grey, c.sigma_depth_m**2, floor, c.cauchy, gate)
        view = (images[level], *pose, self._mount, self._intrinsics)
        used = linearise(self._patches.arrays, level, view, trust, H, g, fate)
        H, g = _marginal(H / self._inflation, g / self._inflation, self._sigma_ground)
        return Normal(pose[0].copy(), pose[1].copy(), H, g, used, len(fate))

    def _refill(
        self, pixels: Bytes2D, images: list[Array32], filter_: Filter, target: PointMap, planes: PlaneConfig
    ) -> None:
        corners = self._corners(pixels, filter_)
        if not len(corners):
            return
        state = filter_.state
        anchors, found, good = self._ground.meet(corners, state, target, planes)
        origin, rays = self._ground.rays(corners, state)
        per_px = (state.R @ self._mount[0])[:, :2] / self._intrinsics[0]
        view = (origin, rays[good], per_px)
        new = cut(images, corners[good], (anchors[good], found[good]), view, self._direct.half_px)
        new = new.only(new.energy[:, 0] > 0.0)
        self.renewed = len(new) / max(len(self._patches) + len(new), 1)
        self._patches = self._patches.joined(new)

    def _corners(self, pixels: Bytes2D, filter_: Filter) -> Array32:
        """Where patches of good slopes lie that are not near one there is, (N, 2)."""
        c = self._direct
        mask = np.zeros(pixels.shape, np.uint8)
        border = c.half_px + 3
        mask[border:-border, border:-border] = 255
        for u, v in self._project(filter_):
            cv2.circle(mask, (int(u), int(v)), c.spacing_px, 0, -1)
        corners = cv2.goodFeaturesToTrack(
            pixels,
            c.patches - len(self._patches),
            c.corner_quality,
            c.spacing_px,
            mask=mask,
            blockSize=2 * c.half_px + 1,
        )
        return np.zeros((0, 2), np.float32) if corners is None else np.asarray(corners, np.float32).reshape(-1, 2)

    def _project(self, filter_: Filter) -> Array:
        """Centres of the patches as OpenCV pixels (N, 2)."""
        R_body_cam, p_cam = self._mount
        optical = ((self._patches.centres - filter_.state.p) @ filter_.state.R - p_cam) @ R_body_cam
        scale = self._intrinsics[0] / np.maximum(optical[:, 2], 0.1)
        return np.asarray(optical[:, :2] * scale[:, None] + self._intrinsics[1:] - 0.5)


def _marginal(H: Array, g: Array, sigmas: Array) -> tuple[Array, Array]:
    """Normal equations of the first six unknowns, the others known to `sigmas` about zero (Schur)."""
    H, g = H.copy(), g.copy()
    eliminate(H, g, sigmas)
    return H[:6, :6], g[:6]
