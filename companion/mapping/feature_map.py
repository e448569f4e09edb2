"""The map of landmarks: where single things are, how sure that is, and by what they are known again.

Each landmark is a small Kalman filter of a thing that does not move (the textbook's feature map:
S. Thrun, W. Burgard, D. Fox, "Probabilistic Robotics", 2005, ch. 10). Correlations between
landmarks and between observations are left out: an error that all observations of a landmark
share (a map's cells, a drift) does not average out, which `independence` accounts for.
"""

from __future__ import annotations

from typing import Annotated, Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from companion.core.errors import InputError
from companion.core.messages import Array
from companion.mapping import feature_bytes
from companion.mapping.association import NEW, AssociationConfig, Observations, Rows, associate
from companion.mapping.feature_bytes import LANDMARK

_Count = Annotated[int, msgspec.Meta(ge=1)]


class FeatureMapConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """How landmarks are matched, and which are kept."""

    association: AssociationConfig = AssociationConfig()
    capacity: Annotated[int, msgspec.Meta(ge=1, le=1_000_000)] = 20_000  # landmarks; the least proven go first
    independence: Annotated[float, msgspec.Meta(gt=0.0, le=1.0)] = 1.0
    """Share of a later observation's information that is new; 1: errors of observations are independent."""
    proven: _Count = 2  # observations from which on a landmark is kept for good
    forget_after_s: Annotated[float, msgspec.Meta(gt=0.0)] = 30.0  # without another look, unless proven


class FeatureMap:
    """Landmarks in `odom`; `landmarks` (N,) is a struct array (`LANDMARK`), ordered by id.

    >>> features = FeatureMap(FeatureMapConfig())
    >>> seen = Observations.of(position_odom, covariance, TRUNK, radius_m=radius_m)
    >>> rows = features.observe(seen, stamp_ns=0)  # row of each in features.landmarks
    >>> features.near(p_odom, radius_m=5.0)["position_odom"]
    """

    def __init__(self, config: FeatureMapConfig) -> None:
        self.config = config
        self.landmarks: NDArray[Any] = np.empty(0, LANDMARK)
        self.version = 0  # grows with every change
        self._next_id = 0

    def __len__(self) -> int:
        return len(self.landmarks)

    def associate(self, seen: Observations) -> Rows:
        """Row (M,) of each observation, NEW (-1), or AMBIGUOUS (-2); no row twice."""
        return associate(self.landmarks, seen, self.config.association)

    def observe(self, seen: Observations, stamp_ns: int) -> Rows:
        """Associate, update what was known, add what is new; returns what `associate` said."""
        rows = self.associate(seen)
        self.update(seen, rows, stamp_ns)
        self.add(seen, rows == NEW, stamp_ns)
        return rows

    def update(self, seen: Observations, rows: Rows, stamp_ns: int) -> None:
        """Fuse each observation whose row is >= 0 into that landmark; the others are passed over.

        Information form: P'^-1 = P^-1 + a R^-1, x' = P' (P^-1 x + a R^-1 z) with a = `independence`;
        for a = 1 that is, any number of times, least squares over all of them. The newest descriptor
        stays, since light and view change; radii are averaged. Raises InputError if a row is
        named twice or not there.
        """
        which = np.flatnonzero(rows >= 0)
        at = rows[which]
        if len(rows) != len(seen) or len(np.unique(at)) != len(at) or np.any(at >= len(self)):
            raise InputError("one row per observation, none twice", field="rows", valid=f"below {len(self)}")
        known = self.landmarks[at]
        before = _inverse(known["covariance"])
        gained = self.config.independence * _inverse(seen.covariance[which])
        covariance = _inverse(before + gained)
        covariance = 0.5 * (covariance + covariance.transpose(0, 2, 1))
        weighted = _times(before, known["position_odom"]) + _times(gained, seen.position_odom[which])
        known["position_odom"] = _times(covariance, weighted)
        known["covariance"] = covariance
        known["radius_m"] = _mean_radius(known, seen.radius_m[which])
        known["descriptor"] = seen.descriptor[which]
        known["observations"] += 1
        known["last_ns"] = np.maximum(known["last_ns"], stamp_ns)
        self.landmarks[at] = known
        self.version += len(at) > 0

    def add(self, seen: Observations, which: NDArray[np.bool_], stamp_ns: int) -> NDArray[np.int64]:
        """New landmarks of the observations in `which` (M,); returns their ids.

        Beyond the capacity the landmarks with the fewest observations go, of those the ones
        seen longest ago; ids are never given twice.
        """
        fresh = np.zeros(int(np.count_nonzero(which)), LANDMARK)
        fresh["id"] = self._next_id + np.arange(len(fresh))
        for name in ("position_odom", "covariance", "kind", "descriptor", "radius_m"):
            fresh[name] = getattr(seen, name)[which]
        fresh["observations"], fresh["first_ns"], fresh["last_ns"] = 1, stamp_ns, stamp_ns
        self._next_id += len(fresh)
        self.landmarks = np.concatenate([self.landmarks, fresh])
        self.version += len(fresh) > 0
        surplus = len(self) - self.config.capacity
        if surplus > 0:
            order = np.lexsort((self.landmarks["id"], self.landmarks["last_ns"], self.landmarks["observations"]))
            self._drop(order[:surplus])
        return np.asarray(fresh["id"])

    def move(self, R: Array, t: Array) -> None:
        """Take each landmark to R p + t: rotations (N, 3, 3) and shifts (N, 3), m, one per row."""
        moved = self.landmarks.copy()
        moved["position_odom"] = _times(R, self.landmarks["position_odom"]) + t
        turned = R @ self.landmarks["covariance"] @ R.transpose(0, 2, 1)
        moved["covariance"] = 0.5 * (turned + turned.transpose(0, 2, 1))
        self.landmarks = moved
        self.version += len(moved) > 0

    def prune(self, now_ns: int) -> int:
        """Forget what was seen too seldom, and not lately; returns how many."""
        old = now_ns - self.landmarks["last_ns"] > round(self.config.forget_after_s * 1e9)
        gone = np.flatnonzero(old & (self.landmarks["observations"] < self.config.proven))
        self._drop(gone)
        return len(gone)

    def near(self, p_odom: Array, radius_m: float) -> NDArray[Any]:
        """Copies of the landmarks within a distance of a point (3,), m."""
        away = self.landmarks["position_odom"] - p_odom
        within = (away * away).sum(axis=1) <= radius_m**2
        return np.asarray(self.landmarks[within])

    def to_bytes(self) -> bytes:
        """Everything, with version and checksum; the same map gives the same bytes."""
        return feature_bytes.pack(self.landmarks, self._next_id)

    @classmethod
    def from_bytes(cls, data: bytes, config: FeatureMapConfig | None = None) -> FeatureMap:
        """Inverse of `to_bytes`; InputError if the bytes are damaged, cut, or of another version."""
        features = cls(config or FeatureMapConfig())
        features.landmarks, features._next_id = feature_bytes.unpack(data, most=features.config.capacity)
        return features

    def _drop(self, rows: Rows) -> None:
        if len(rows):
            self.landmarks = np.delete(self.landmarks, rows)
            self.version += 1


def _inverse(matrices: Array) -> Array:
    return np.asarray(np.linalg.inv(matrices), np.float64)


def _times(matrices: Array, vectors: Array) -> Array:
    """(N, 3, 3) times (N, 3)."""
    product: Array = (matrices @ vectors[:, :, None])[:, :, 0]
    return product


def _mean_radius(known: NDArray[Any], radius_m: Array) -> Array:
    before = known["radius_m"]
    mean = before + (radius_m - before) / (known["observations"] + 1)
    return np.where(np.isnan(before), radius_m, np.where(np.isnan(radius_m), before, mean))
