"""Registered scans and local maps in, tracks of moving obstacles out."""

from __future__ import annotations

from collections import deque
from typing import Annotated

import msgspec
import numpy as np

from companion.core.geometry import rotation_from_quaternion
from companion.core.messages import Array, LocalMap, ObstacleTracks, RegisteredScan
from companion.core.node import Node, Outputs, on
from companion.core.topics import LOCAL_MAP, OBSTACLE_TRACKS, REGISTERED
from companion.estimation.tracks.tracker import Tracker, TrackerConfig
from companion.estimation.tracks.unexpected import Background, ClusterConfig, beside, clusters, joined, unexpected

_MAPS = 20  # kept at most


class ObstacleTracksConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Tracks of what moves."""

    enabled: bool = True
    map_age_s: Annotated[float, msgspec.Meta(gt=0, le=2)] = 0.8  # of the map that says what is expected, at least
    old_map_age_s: Annotated[float, msgspec.Meta(gt=0, le=4)] = 3.2  # of the map asked, too, beside what moves
    beside_m: Annotated[float, msgspec.Meta(ge=0)] = 1.5  # how near that is, in plan
    every_scans: Annotated[int, msgspec.Meta(ge=1, le=5)] = 2  # scans per look
    clusters: ClusterConfig = ClusterConfig()
    tracker: TrackerConfig = TrackerConfig()


class ObstacleTracksNode(Node):
    """Compares scans with the map of a moment ago; publishes the tracks that are believed, if there are any.

    Tracks live in `odom`. After the last one is gone one empty message says so.
    """

    publishes = (OBSTACLE_TRACKS,)

    def __init__(self, config: ObstacleTracksConfig) -> None:
        self.config = config
        self.tracker = Tracker(config.tracker)
        self._maps: deque[Background] = deque(maxlen=_MAPS)
        self._said = self._scans = 0
        _compile(config.clusters)

    @on(LOCAL_MAP)
    def map(self, local_map: LocalMap) -> None:
        """Keep its states for later."""
        kept = Background(local_map.stamp_ns, local_map.origin_odom, local_map.resolution_m, local_map.state)
        self._maps.append(kept)

    @on(REGISTERED)
    def scan(self, scan: RegisteredScan) -> Outputs:
        """Follow what the map did not expect."""
        self._scans += 1
        if self._scans % self.config.every_scans:
            return
        known = self._expected(scan.stamp_ns, self.config.map_age_s)
        if known is None or scan.stamp_ns <= self.tracker.stamp_ns or not np.isfinite(scan.p_odom).all():
            return
        self.tracker.update(clusters(self._news(scan, known), self.config.clusters), scan.stamp_ns)
        tracks = self.tracker.confirmed
        if tracks or self._said:
            yield OBSTACLE_TRACKS(self._message(scan.stamp_ns))
        self._said = len(tracks)

    def _news(self, scan: RegisteredScan, known: Background) -> Array:
        """Points (M, 3) in odom that are new; beside what moves also those that a longer memory calls new."""
        R, config = rotation_from_quaternion(scan.q_odom_body), self.config
        points = unexpected(scan.points_body, R, scan.p_odom, known, config.clusters)
        places = self.tracker.expected_odom(scan.stamp_ns)
        old = self._expected(scan.stamp_ns, config.old_map_age_s) if len(places) else None
        if old is None:
            return points
        more = unexpected(scan.points_body, R, scan.p_odom, old, config.clusters)
        return joined(points, beside(more, places, config.beside_m))

    def _expected(self, stamp_ns: int, age_s: float) -> Background | None:
        """The newest map that is old enough."""
        age_ns = round(age_s * 1e9)
        return next((m for m in reversed(self._maps) if m.stamp_ns <= stamp_ns - age_ns), None)

    def _message(self, stamp_ns: int) -> ObstacleTracks:
        tracks = self.tracker.confirmed
        x = np.array([t.filter.x for t in tracks]).reshape(-1, 6)
        P = np.array([t.filter.P for t in tracks]).reshape(-1, 6, 6)
        return ObstacleTracks(
            stamp_ns=stamp_ns,
            id=np.array([t.id for t in tracks], np.int64),
            position_odom=x[:, :3].copy(),
            velocity_odom=x[:, 3:].copy(),
            position_variance=P[:, 0, 0].copy(),
            velocity_variance=P[:, 3, 3].copy(),
            cross_covariance=P[:, 0, 3].copy(),
            radius_m=np.array([t.radius_m for t in tracks], np.float64),
        )


def _compile(config: ClusterConfig) -> None:
    """Kernels, before the flight."""
    free = Background(0, np.zeros(3), 1.0, np.ones((3, 3, 3), np.uint8))
    found = unexpected(np.full((1, 3), 0.5, np.float32), np.eye(3), np.ones(3), free, config)
    clusters(np.repeat(found, config.min_points, axis=0), config)
