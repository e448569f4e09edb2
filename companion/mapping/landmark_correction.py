"""Landmarks follow corrected poses: each goes where the pose went from which it was last seen."""

from __future__ import annotations

import numpy as np

from companion.core.errors import InputError
from companion.core.messages import Array, PoseCorrections
from companion.mapping.feature_map import FeatureMap
from companion.mapping.pose_track import PoseCorrector, PoseTrack


class LandmarkCorrection:
    """Keeps the poses of the looks, and what the last correction made of them.

    A correction says where all poses of the flight belong, so a landmark that an earlier one
    moved goes by the difference of the two.
    """

    def __init__(self) -> None:
        self.skipped = 0  # corrections that were no poses, or before the first look
        self._track = PoseTrack()
        self._last: PoseCorrector | None = None

    def looked(self, stamp_ns: int, p_odom: Array, q_odom_body: Array) -> None:
        """A look from a pose, newer than all before."""
        self._track.add(stamp_ns, p_odom, q_odom_body)

    def apply(self, features: FeatureMap, corrections: PoseCorrections) -> None:
        """Move the landmarks; a correction that is none moves nothing."""
        if self._track.count == 0:
            self.skipped += 1
            return
        try:
            new = PoseCorrector(self._track, corrections.stamps_ns, corrections.p_odom, corrections.q_odom_body)
        except InputError:
            self.skipped += 1
            return
        stamps_ns, which = np.unique(features.landmarks["last_ns"], return_inverse=True)
        R, t = np.tile(np.eye(3), (len(stamps_ns), 1, 1)), np.zeros((len(stamps_ns), 3))
        for k, stamp_ns in enumerate(stamps_ns.tolist()):
            R[k], t[k] = self._between(new, stamp_ns)
        features.move(R[which], t[which])
        self._last = new

    def _between(self, new: PoseCorrector, stamp_ns: int) -> tuple[Array, Array]:
        """From where the last correction put what was seen at a time to where the new one does."""
        to = new.shift_at(stamp_ns)
        if self._last is None:
            return to.R, to.t
        was = self._last.shift_at(stamp_ns)
        R = to.R @ was.R.T
        return R, to.t - R @ was.t
