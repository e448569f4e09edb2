"""Landmarks: images, poses and local maps in; the feature map out."""

from __future__ import annotations

from collections import deque
from itertools import pairwise
from typing import Annotated

import msgspec
import numpy as np

from companion.core.geometry import quaternion_from_rotation, rotation_from_quaternion
from companion.core.messages import CameraImage, Landmarks, LocalMap, Odometry, PoseCorrections
from companion.core.node import Node, Outputs, on
from companion.core.rig import Rig
from companion.core.topics import CAMERA, CORRECTIONS, LANDMARKS, LOCAL_MAP, ODOMETRY
from companion.mapping.association import TRUNK, VISUAL, Observations
from companion.mapping.back_projection import BackProjectionConfig, Pose, back_project
from companion.mapping.feature_map import FeatureMap, FeatureMapConfig
from companion.mapping.keypoints import KeypointConfig, Keypoints
from companion.mapping.landmark_correction import LandmarkCorrection
from companion.mapping.trunks import TrunkConfig, trunks

_Hertz = Annotated[float, msgspec.Meta(gt=0.0, le=30.0)]
_POSES = 100  # a second of odometry: an image is never later


class LandmarkConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """What is seen as a landmark, how often, and what is kept of it."""

    enabled: bool = True
    image_rate_hz: _Hertz = 1.5  # images looked at, at most
    trunk_rate_hz: _Hertz = 0.4  # local maps looked at, at most
    publish_every: Annotated[int, msgspec.Meta(ge=1)] = 8  # images looked at per message
    keypoints: KeypointConfig = KeypointConfig()
    back_projection: BackProjectionConfig = BackProjectionConfig()
    trunks: TrunkConfig = TrunkConfig()
    features: FeatureMapConfig = FeatureMapConfig(independence=0.1)
    """Most of a landmark's error is that of the map's cells under it, which every look shares."""


class LandmarkNode(Node):
    """Puts keypoints on the ground and tree trunks into one feature map.

    `features` is that map, for saving at the end of a flight. An image is looked at when the
    next one comes: by then the odometry around its stamp is there. Images without a pose or
    a local map are passed over, and counted in `skipped`; trunks are looked for beside images.
    """

    publishes = (LANDMARKS,)

    def __init__(self, config: LandmarkConfig, rig: Rig) -> None:
        self.config, self.rig = config, rig
        self.features = FeatureMap(config.features)
        self.images = self.skipped = 0
        self.correction = LandmarkCorrection()
        self._keypoints = Keypoints(config.keypoints)
        self._poses: deque[Odometry] = deque(maxlen=_POSES)
        self._map: LocalMap | None = None
        self._waiting: CameraImage | None = None
        self._image_due_ns = self._trunks_due_ns = 0

    @on(ODOMETRY)
    def follow(self, odometry: Odometry) -> None:
        """Remember the last second of poses; none of before a new start of the estimate."""
        if self._poses and odometry.reset_counter != self._poses[-1].reset_counter:
            self._poses.clear()
        self._poses.append(odometry)

    @on(LOCAL_MAP)
    def keep(self, local_map: LocalMap) -> None:
        """The newest local map."""
        self._map = local_map

    @on(CORRECTIONS)
    def correct(self, corrections: PoseCorrections) -> None:
        """Landmarks follow the poses from which they were seen."""
        self.correction.apply(self.features, corrections)

    @on(CAMERA)
    def see(self, image: CameraImage) -> Outputs:
        """Look at the image before this one, if it is time for that."""
        before, self._waiting = self._waiting, None
        if self.config.enabled and image.stamp_ns >= self._image_due_ns:
            self._image_due_ns = image.stamp_ns + round(1e9 / self.config.image_rate_hz)
            self._waiting = image
        if before is None:
            return
        pose = self._pose_at(before.stamp_ns)
        if pose is None or self._map is None:
            self.skipped += 1
            return
        self.correction.looked(before.stamp_ns, pose.p_odom, quaternion_from_rotation(pose.R_odom_body))
        self._observe_ground(before, pose, self._map)
        if self._map.stamp_ns >= self._trunks_due_ns:
            self._trunks_due_ns = self._map.stamp_ns + round(1e9 / self.config.trunk_rate_hz)
            self._observe_trunks(pose, self._map)
        self.images += 1
        if self.images % self.config.publish_every == 0:
            self.features.prune(before.stamp_ns)
            yield LANDMARKS(self._message(before.stamp_ns))

    def _observe_ground(self, image: CameraImage, pose: Pose, local_map: LocalMap) -> None:
        """Keypoints on the ground alone: of one at a branch's edge nobody knows which side it is on."""
        uv_px, descriptors = self._keypoints.find(image.pixels)
        surface = back_project(uv_px, pose, self.rig, local_map, self.config.back_projection)
        kept = surface.ground
        points = Observations.of(
            surface.position_odom[kept], surface.covariance[kept], VISUAL, descriptor=descriptors[kept]
        )
        self.features.observe(points, image.stamp_ns)

    def _observe_trunks(self, pose: Pose, local_map: LocalMap) -> None:
        seen = trunks(local_map, pose.p_odom, self.config.trunks)
        covariance = seen.covariance + np.diag(pose.variance[3:])
        trees = Observations.of(seen.position_odom, covariance, TRUNK, radius_m=seen.radius_m)
        self.features.observe(trees, local_map.stamp_ns)

    def _pose_at(self, stamp_ns: int) -> Pose | None:
        """The pose at a stamp; None if it is not between two known ones."""
        for a, b in pairwise(self._poses):
            if a.stamp_ns <= stamp_ns <= b.stamp_ns:
                return _between(a, b, stamp_ns)
        return None

    def _message(self, stamp_ns: int) -> Landmarks:
        rows = self.features.landmarks
        return Landmarks(
            stamp_ns=stamp_ns,
            id=rows["id"].astype(np.int64),
            position_odom=rows["position_odom"].astype(np.float64),
            sigma_m=np.sqrt(np.trace(rows["covariance"], axis1=1, axis2=2) / 3.0),
            kind=rows["kind"].astype(np.uint8),
            radius_m=rows["radius_m"].astype(np.float64),
            observations=rows["observations"].astype(np.int64),
        )


def _between(a: Odometry, b: Odometry, stamp_ns: int) -> Pose:
    """10 ms apart, so that a normalised mean of quaternions is as good as the arc."""
    share = (stamp_ns - a.stamp_ns) / max(b.stamp_ns - a.stamp_ns, 1)
    q_b = b.q_odom_body if float(a.q_odom_body @ b.q_odom_body) >= 0.0 else -b.q_odom_body
    q = (1.0 - share) * a.q_odom_body + share * q_b
    p = (1.0 - share) * a.p_odom + share * b.p_odom
    return Pose(p, rotation_from_quaternion(q / np.linalg.norm(q)), b.pose_variance)
