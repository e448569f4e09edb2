"""Poses of the flight as they were believed, and where they belong after a correction."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from companion.core.errors import InputError
from companion.core.geometry import exp_so3, log_so3, quaternion_from_rotation, rotation_from_quaternion
from companion.core.messages import Array

_GROWTH = 4096  # poses


class PoseTrack:
    """Poses of the body in `odom`, in order of time."""

    def __init__(self) -> None:
        self.count = 0
        self._stamps_ns = np.empty(_GROWTH, np.int64)
        self._p = np.empty((_GROWTH, 3))
        self._q = np.empty((_GROWTH, 4))

    @property
    def memory_bytes(self) -> int:
        """Bytes held, spare capacity included."""
        return self._stamps_ns.nbytes + self._p.nbytes + self._q.nbytes

    @property
    def newest_ns(self) -> int:
        """Stamp of the newest pose; the track must not be empty."""
        return int(self._stamps_ns[self.count - 1])

    def add(self, stamp_ns: int, p_odom: Array, q_odom_body: Array) -> None:
        """One more pose, newer than all before."""
        if self.count == len(self._stamps_ns):
            more = (self.count + _GROWTH, self.count)
            self._stamps_ns = np.resize(self._stamps_ns, more[0])
            self._p, self._q = np.resize(self._p, (more[0], 3)), np.resize(self._q, (more[0], 4))
        self._stamps_ns[self.count], self._p[self.count], self._q[self.count] = stamp_ns, p_odom, q_odom_body
        self.count += 1

    def at(self, stamp_ns: int) -> tuple[Array, Array]:
        """Pose (R_odom_body (3, 3), p_odom (3,)) at a time, between two poses on SE(3); ends hold."""
        k = int(np.searchsorted(self._stamps_ns[: self.count], stamp_ns))
        before, after = max(k - 1, 0), min(k, self.count - 1)
        a, b = self._pose(before), self._pose(after)
        if before == after or stamp_ns >= self._stamps_ns[after]:
            return b
        gap = int(self._stamps_ns[after] - self._stamps_ns[before])
        return between(a, b, (stamp_ns - int(self._stamps_ns[before])) / gap)

    def _pose(self, k: int) -> tuple[Array, Array]:
        return rotation_from_quaternion(self._q[k]), self._p[k].copy()


@dataclass(frozen=True, slots=True, eq=False)
class PoseShift:
    """Rigid motion p -> R p + t in `odom`."""

    R: Array  # (3, 3)
    t: Array  # (3,), m

    def of_pose(self, pose: tuple[Array, Array]) -> tuple[Array, Array]:
        """Where a pose (R, p) goes."""
        return self.R @ pose[0], self.R @ pose[1] + self.t

    def size_m(self, p_odom: Array, radius_m: float) -> float:
        """Bound on how far anything within `radius_m` of a point (3,) goes."""
        return float(np.linalg.norm(self.R @ p_odom + self.t - p_odom) + np.linalg.norm(log_so3(self.R)) * radius_m)


class PoseCorrector:
    """Where the scans of a track belong when some of its poses are corrected.

    `stamps_ns` (K,), ascending, name the corrected poses `p_odom` (K, 3), `q_odom_body` (K, 4).
    The newest of them does not move: all others are seen from it, since `odom` never jumps and
    what was scanned after it must fit. Raises InputError if they are no poses in order.
    """

    def __init__(self, track: PoseTrack, stamps_ns: NDArray[np.int64], p_odom: Array, q_odom_body: Array) -> None:
        self.track = track
        self.stamps_ns = _checked(np.asarray(stamps_ns), p_odom, q_odom_body)
        believed = [track.at(int(stamp)) for stamp in self.stamps_ns]
        corrected = [
            (rotation_from_quaternion(q / np.linalg.norm(q)), p) for p, q in zip(p_odom, q_odom_body, strict=True)
        ]
        anchor = _shift(corrected[-1], believed[-1])
        self._shifts = [_shift(b, anchor.of_pose(c)) for b, c in zip(believed, corrected, strict=True)]

    def shift_at(self, stamp_ns: int) -> PoseShift:
        """How what was scanned at a time moves: on SE(3) between where its two neighbours in time would take it."""
        k = int(np.searchsorted(self.stamps_ns, stamp_ns))
        if k == len(self.stamps_ns):
            return PoseShift(np.eye(3), np.zeros(3))
        if k == 0 or stamp_ns == self.stamps_ns[k]:
            return self._shifts[k]
        pose = self.track.at(stamp_ns)
        share = (stamp_ns - int(self.stamps_ns[k - 1])) / int(self.stamps_ns[k] - self.stamps_ns[k - 1])
        there = between(self._shifts[k - 1].of_pose(pose), self._shifts[k].of_pose(pose), share)
        return _shift(pose, there)


def between(a: tuple[Array, Array], b: tuple[Array, Array], share: float) -> tuple[Array, Array]:
    """Pose (R, p) at a share 0..1 of the way from `a` to `b`: shortest turn, straight line."""
    return a[0] @ exp_so3(share * log_so3(a[0].T @ b[0])), a[1] + share * (b[1] - a[1])


def _shift(a: tuple[Array, Array], b: tuple[Array, Array]) -> PoseShift:
    """The motion that takes pose `a` to pose `b`."""
    R = rotation_from_quaternion(quaternion_from_rotation(b[0] @ a[0].T))  # a rotation to the last bit
    return PoseShift(R, b[1] - R @ a[1])


def _checked(stamps_ns: NDArray[np.int64], p_odom: Array, q_odom_body: Array) -> NDArray[np.int64]:
    count = len(stamps_ns)
    if count == 0 or p_odom.shape != (count, 3) or q_odom_body.shape != (count, 4):
        shapes = (stamps_ns.shape, p_odom.shape, q_odom_body.shape)
        raise InputError(f"shapes {shapes}", field="corrections", valid="(K,), (K, 3), (K, 4), K >= 1")
    if np.any(np.diff(stamps_ns) <= 0):
        raise InputError("stamps are not ascending", field="corrections.stamps_ns")
    turned = np.abs(np.linalg.norm(q_odom_body, axis=1) - 1.0) < 1e-3
    if not (np.all(np.abs(p_odom) < 1e5) and np.all(turned)):
        raise InputError("not finite, too far, or no rotation", field="corrections", valid="within 100 km, unit")
    return stamps_ns
