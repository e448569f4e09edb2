"""The downward camera: ground points tracked from frame to frame and anchored in the LiDAR map.

Tracks after B. Lucas and T. Kanade (pyramids: J.-Y. Bouguet); depth from the map's planes; the
reprojection error goes into the filter as normal equations. Anchors lie in our own map, so the
camera holds the vehicle where a LiDAR direction is blind, but is no absolute fix.
"""

from __future__ import annotations

from typing import Annotated, Literal

import cv2
import msgspec
import numpy as np
from numba import njit

from companion.core.messages import Array, Array32, Bytes2D
from companion.core.rig import Rig
from companion.estimation.direct_config import DirectConfig
from companion.estimation.filter import Filter
from companion.estimation.ground_rays import GroundRays
from companion.estimation.image_gate import ImageGate, ImageGateConfig
from companion.estimation.normal import Normal
from companion.estimation.point_map import PointMap
from companion.estimation.registration import Flags, PlaneConfig
from companion.estimation.state import State

cv2.setNumThreads(1)  # same bits every time, and the other cores are not ours

Positive = Annotated[float, msgspec.Meta(gt=0)]
Count = Annotated[int, msgspec.Meta(ge=1)]
_BORDER_PX = 8
_WINDOW_PX = 17


class CameraConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Tracking and the trust in it."""

    enabled: bool = True
    method: Literal["tracks", "direct"] = "direct"  # corners followed, or patches aligned by their grey levels
    direct: DirectConfig = DirectConfig()
    image: ImageGateConfig = ImageGateConfig()
    tracks: Count = 120  # at most
    refill_below: Count = 60  # look for new corners when fewer are left
    min_tracks: Annotated[int, msgspec.Meta(ge=4)] = 8
    spacing_px: Count = 10  # between corners
    corner_quality: Positive = 0.01  # against the best corner of the frame
    sigma_px: Positive = 3.2
    cauchy: Positive = 9.0
    first_gate: Positive = 400.0  # chi2 of the first iteration
    gate: Positive = 100.0  # chi2 of the others, and for a track to live on
    inflation: Positive = 4.0
    iterations: Count = 4
    min_depth_m: Positive = 0.3
    max_depth_m: Positive = 40.0


class CameraTracker:
    """Tracks (pixel, anchor in odom) of the last frame."""

    def __init__(self, config: CameraConfig, rig: Rig) -> None:
        self.config = config
        self._R, self._p = np.ascontiguousarray(rig.camera.R_body_sensor), rig.camera.p_body
        pinhole = rig.pinhole
        self._intrinsics = np.array([pinhole.focal_px, *pinhole.center_px])
        self._size = np.array([pinhole.width_px, pinhole.height_px])
        self._last: Bytes2D | None = None
        self._pixels = np.empty((0, 2), np.float32)  # OpenCV's: the centre of the first pixel is 0
        self._anchors = np.empty((0, 3))
        self._ground = GroundRays(rig, depth_m=(config.min_depth_m, config.max_depth_m))
        self._gate = ImageGate(config.image)
        self.objection = ""  # to the last image
        self.renewed = 0.0  # share of the tracks that the last image began

    def update(self, pixels: Bytes2D, filter_: Filter, target: PointMap, planes: PlaneConfig) -> Normal | None:
        """Correct the filter with an image of its own time; None if too few tracks came along."""
        self.renewed, normal = 0.0, None
        self.objection = self._gate.objection(pixels)
        if self.objection:
            self.forget()
            return None
        if self._last is not None and len(self._pixels) >= self.config.min_tracks:
            self._follow(self._last, pixels, filter_)
            if len(self._pixels) >= self.config.min_tracks:
                normal = self._correct(filter_)
        self._last = pixels
        if len(self._pixels) < self.config.refill_below:
            self._refill(pixels, filter_, target, planes)
        used = normal is not None and normal.used >= self.config.min_tracks
        return normal if used else None

    def above_m(self, state: State) -> float:
        """Height above the ground in view."""
        return self._ground.above_m(state)

    def forget(self) -> None:
        """Drop all tracks: the next image begins new ones."""
        self._last = None
        self._keep(np.zeros(len(self._pixels), np.bool_), self._pixels)

    def _follow(self, last: Bytes2D, pixels: Bytes2D, filter_: Filter) -> None:
        guess = self._project(filter_.state.R, filter_.state.p)
        moved, found, _ = cv2.calcOpticalFlowPyrLK(
            last,
            pixels,
            self._pixels.reshape(-1, 1, 2),
            guess.reshape(-1, 1, 2),
            winSize=(_WINDOW_PX, _WINDOW_PX),
            maxLevel=2,
            flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
            criteria=(cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 12, 0.03),
        )
        moved = np.asarray(moved, np.float32).reshape(-1, 2)
        inside = (moved > _BORDER_PX) & (moved < self._size - 1 - _BORDER_PX)
        self._keep((found.ravel() == 1) & inside.all(axis=1), moved)

    def _correct(self, filter_: Filter) -> Normal:
        pixels, anchors = self._pixels + 0.5, self._anchors
        accepted = np.zeros(len(anchors), np.bool_)
        gates = iter([self.config.first_gate])
        c = self.config

        def linearise(R: Array, p: Array) -> Normal:
            H, g = np.empty((6, 6)), np.empty(6)
            limits = (1.0 / c.sigma_px**2, c.cauchy, next(gates, c.gate))
            mount = (self._R, self._p)
            used = _linearise(anchors, pixels, R, p, mount, self._intrinsics, limits, H, g, accepted)
            return Normal(R.copy(), p.copy(), H / c.inflation, g / c.inflation, used, len(anchors))

        normal = filter_.update(linearise, iterations=c.iterations, at_least=c.min_tracks)
        self._keep(accepted, self._pixels)
        return normal

    def _refill(self, pixels: Bytes2D, filter_: Filter, target: PointMap, planes: PlaneConfig) -> None:
        mask = np.full(pixels.shape, 255, np.uint8)
        for u, v in self._pixels:
            cv2.circle(mask, (int(u), int(v)), self.config.spacing_px, 0, -1)
        corners = cv2.goodFeaturesToTrack(
            pixels,
            self.config.tracks - len(self._pixels),
            self.config.corner_quality,
            self.config.spacing_px,
            mask=mask,
        )
        if corners is None:
            return
        found = np.asarray(corners, np.float32).reshape(-1, 2)
        anchors, _, good = self._ground.meet(found, filter_.state, target, planes)
        self.renewed = float(good.sum()) / max(len(self._pixels) + int(good.sum()), 1)
        self._pixels = np.concatenate([self._pixels, found[good]])
        self._anchors = np.concatenate([self._anchors, anchors[good]])

    def _project(self, R: Array, p: Array) -> Array32:
        """Anchors (N, 3) to OpenCV pixels (N, 2)."""
        optical = ((self._anchors - p) @ R - self._p) @ self._R
        scale = self._intrinsics[0] / np.maximum(optical[:, 2], 0.1)
        pixels = optical[:, :2] * scale[:, None] + self._intrinsics[1:] - 0.5
        return np.asarray(pixels, np.float32)

    def _keep(self, which: Flags, pixels: Array32) -> None:
        self._pixels = np.ascontiguousarray(pixels[which])
        self._anchors = np.ascontiguousarray(self._anchors[which])


@njit(cache=True, nogil=True)
def _linearise(anchors, pixels, R, p, mount, intrinsics, limits, H, g, accepted):  # type: ignore[no-untyped-def]
    """Residual r = pixel - projection; A = d projection / d (theta_body, p_odom), (2, 6)."""
    RBC, pBC = mount
    focal, cx, cy = intrinsics
    information, cauchy, gate = limits
    A = np.empty((2, 6))
    b, e = np.empty(3), np.empty(3)
    H[:], g[:] = 0.0, 0.0
    used = 0
    for q in range(anchors.shape[0]):
        accepted[q] = False
        d0, d1, d2 = anchors[q, 0] - p[0], anchors[q, 1] - p[1], anchors[q, 2] - p[2]
        for i in range(3):
            b[i] = R[0, i] * d0 + R[1, i] * d1 + R[2, i] * d2
        e0, e1, e2 = b[0] - pBC[0], b[1] - pBC[1], b[2] - pBC[2]
        for i in range(3):
            e[i] = RBC[0, i] * e0 + RBC[1, i] * e1 + RBC[2, i] * e2
        if e[2] < 0.2:
            continue
        scale = focal / e[2]
        ru, rv = pixels[q, 0] - (scale * e[0] + cx), pixels[q, 1] - (scale * e[1] + cy)
        chi2 = (ru * ru + rv * rv) * information
        if not chi2 <= gate:
            continue
        accepted[q] = True
        used += 1
        for a in range(2):
            slope = -scale * e[a] / e[2]  # d projection / d depth
            h0 = RBC[0, a] * scale + RBC[0, 2] * slope
            h1 = RBC[1, a] * scale + RBC[1, 2] * slope
            h2 = RBC[2, a] * scale + RBC[2, 2] * slope
            A[a, 0], A[a, 1], A[a, 2] = h1 * b[2] - h2 * b[1], h2 * b[0] - h0 * b[2], h0 * b[1] - h1 * b[0]
            for j in range(3):
                A[a, 3 + j] = -(h0 * R[j, 0] + h1 * R[j, 1] + h2 * R[j, 2])
        root = cauchy / (cauchy + chi2)
        weight = root * root * information
        for i in range(6):
            g[i] += weight * (A[0, i] * ru + A[1, i] * rv)
            for j in range(i, 6):
                H[i, j] += weight * (A[0, i] * A[0, j] + A[1, i] * A[1, j])
    for i in range(6):
        for j in range(i):
            H[i, j] = H[j, i]
    return used
