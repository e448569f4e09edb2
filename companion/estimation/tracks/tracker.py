"""Kalman filters of constant velocity for things that come and go: assignment, birth, doubt and death.

Source: S. Blackman and R. Popoli, "Design and Analysis of Modern Tracking Systems", 1999, ch. 6
(global nearest neighbour, M of N confirmation); assignment: H. Kuhn, 1955.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated

import msgspec
import numpy as np
from scipy.optimize import linear_sum_assignment

from companion.core.messages import Array
from companion.estimation.filters.kalman import KalmanFilter, constant_velocity
from companion.estimation.tracks.unexpected import Clusters

Positive = Annotated[float, msgspec.Meta(gt=0)]
Count = Annotated[int, msgspec.Meta(ge=1)]
_SEE_POSITION = np.eye(3, 6)
_NEVER = 1e6


class TrackerConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Model of motion, gate, and when a track is believed and dropped."""

    accel_density_m2_s3: Positive = 1.0
    sigma_m: Positive = 0.15  # of a cluster's middle about the thing's, in plan
    sigma_height_m: Positive = 0.5  # the same of its height: how much of a thing is seen changes
    first_speed_m_s: Positive = 1.5  # sigma of a new track's velocity in plan
    first_climb_m_s: Positive = 0.3  # and up
    gate_nis: Positive = 16.3  # 99.9 % of three axes
    hits: Count = 3  # clusters until it is believed ...
    moved_m: Positive = 0.6  # ... and way from where it was first seen
    patience_s: Positive = 2.0  # without a cluster, believed: a thing below is out of sight
    doubt_s: Positive = 0.45  # without a cluster, not yet believed


@dataclass(slots=True)
class Track:
    """One thing; x of the filter holds position and velocity in odom."""

    id: int
    filter: KalmanFilter
    first_odom: Array
    seen_ns: int
    radius_m: float
    hits: int = 1
    confirmed: bool = False


@dataclass(slots=True)
class Tracker:
    """Feed clusters in stamp order; `confirmed` are the tracks that are believed."""

    config: TrackerConfig
    tracks: list[Track] = field(default_factory=list)
    stamp_ns: int = 0
    born: int = 0

    @property
    def confirmed(self) -> list[Track]:
        """By id."""
        return [track for track in self.tracks if track.confirmed]

    def expected_odom(self, stamp_ns: int) -> Array:
        """Where the believed things should be at the stamp, (K, 3), m."""
        dt_s = (stamp_ns - self.stamp_ns) * 1e-9
        places = [track.filter.x[:3] + dt_s * track.filter.x[3:] for track in self.confirmed]
        return np.array(places).reshape(-1, 3)

    def update(self, seen: Clusters, stamp_ns: int) -> None:
        """Predict to the stamp, assign clusters to tracks, correct, begin and end tracks."""
        if self.tracks:
            dt_s = (stamp_ns - self.stamp_ns) * 1e-9
            F, Q = constant_velocity(dt_s, accel_density=self.config.accel_density_m2_s3, axes=3)
            for track in self.tracks:
                track.filter.predict(F, Q)
        self.stamp_ns = stamp_ns
        free = set(range(len(seen.centre_odom)))
        for track, k in self._assigned(seen):
            self._correct(track, seen, k)
            free.discard(k)
        self._drop()
        for k in sorted(free):
            self._begin(seen, k)

    def _assigned(self, seen: Clusters) -> list[tuple[Track, int]]:
        """Pairs whose sum of normalised innovations is least, none beyond the gate."""
        if not self.tracks or not len(seen.centre_odom):
            return []
        place = np.array([track.filter.x[:3] for track in self.tracks])
        S = np.array([track.filter.P[:3, :3] for track in self.tracks]) + self._noise()
        off = seen.centre_odom - place[:, None]
        nis = np.einsum("tki,tij,tkj->tk", off, np.linalg.inv(S), off)
        cost = np.where(nis < self.config.gate_nis, nis, _NEVER)
        rows, columns = linear_sum_assignment(cost)
        return [(self.tracks[i], int(k)) for i, k in zip(rows, columns, strict=True) if cost[i, k] < _NEVER]

    def _correct(self, track: Track, seen: Clusters, k: int) -> None:
        track.filter.update(seen.centre_odom[k], _SEE_POSITION, self._noise())
        track.hits += 1
        track.seen_ns = self.stamp_ns
        track.radius_m += 0.2 * (float(seen.radius_m[k]) - track.radius_m)
        moved = float(np.linalg.norm((track.filter.x[:3] - track.first_odom)[:2]))
        track.confirmed |= track.hits >= self.config.hits and moved >= self.config.moved_m

    def _drop(self) -> None:
        patience = {True: self.config.patience_s, False: self.config.doubt_s}
        self.tracks = [t for t in self.tracks if (self.stamp_ns - t.seen_ns) * 1e-9 <= patience[t.confirmed]]

    def _begin(self, seen: Clusters, k: int) -> None:
        centre = seen.centre_odom[k]
        c = self.config
        speeds = [c.first_speed_m_s, c.first_speed_m_s, c.first_climb_m_s]
        P = np.diag([c.sigma_m, c.sigma_m, c.sigma_height_m, *speeds]) ** 2
        start = KalmanFilter(np.concatenate([centre, np.zeros(3)]), P)
        self.tracks.append(Track(self.born, start, centre.copy(), self.stamp_ns, float(seen.radius_m[k])))
        self.born += 1

    def _noise(self) -> Array:
        return np.diag([self.config.sigma_m, self.config.sigma_m, self.config.sigma_height_m]) ** 2
