"""Following the pose graph during a flight: submaps are kept, corrections come, the map follows."""

from __future__ import annotations

import msgspec

from companion.core.errors import InputError
from companion.core.messages import Array, PoseCorrections
from companion.mapping.blocks import Watch
from companion.mapping.correction import Corrected, Correction, CorrectionConfig
from companion.mapping.pose_track import PoseCorrector
from companion.mapping.submaps import SubmapConfig, Submaps
from companion.mapping.voxel_map import VoxelMap

_LET_GO = 32_768  # blocks per scan: giving much memory back takes time, too


class FollowConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Whether and how the map follows corrected poses."""

    enabled: bool = True  # costs a seventh of insertion, and 60 MB per km at 0.2 m
    submaps: SubmapConfig = SubmapConfig()
    correction: CorrectionConfig = CorrectionConfig()


class MapFollower:
    """Runs one correction at a time, a bounded step per scan.

    Corrections name poses of the whole flight, so the newest alone counts: one that comes while
    another runs waits, and takes the place of one that waits. What runs goes on to its end, since
    a graph that says something new every second would else never see its word done.
    """

    def __init__(self, config: FollowConfig, voxels: VoxelMap) -> None:
        self.config = config
        self.voxels = voxels
        self.submaps = Submaps(config.submaps, voxels) if config.enabled else None
        self.failure: str | None = None  # why no correction is possible any more
        self.skipped = 0  # corrections that were no poses, or of no flight
        self._running: Correction | None = None
        self._waiting: PoseCorrector | None = None
        self._replaced: VoxelMap | None = None  # the map before the last correction, on its way out

    @property
    def watch(self) -> Watch | None:
        """The argument of that name of `VoxelMap.insert`."""
        return self.submaps.watch if self.submaps and not self.failure else None

    @property
    def busy(self) -> bool:
        """A correction runs or waits."""
        return self._running is not None or self._waiting is not None

    def take(self, corrections: PoseCorrections) -> None:
        """Begin with the next scan, or when the running correction is done."""
        if self.submaps is None or self.failure or self.submaps.track.count == 0:
            self.skipped += 1
            return
        try:
            self._waiting = PoseCorrector(
                self.submaps.track, corrections.stamps_ns, corrections.p_odom, corrections.q_odom_body
            )
        except InputError:
            self.skipped += 1

    def after_scan(self, stamp_ns: int, p_odom: Array, q_odom_body: Array) -> Corrected | None:
        """A scan is in the map: note its pose, and do a step; returns what was done when it is done."""
        if self._replaced and not self._replaced.let_go(_LET_GO):
            self._replaced = None
        if self.submaps is None or self.failure:
            return None
        self.submaps.after_scan(stamp_ns, p_odom, q_odom_body)
        if self._running is None:
            self._running = self._begin()
        running = self._running
        try:
            done = running.advance() if running else None
        except OSError as error:  # the map stays as it is, and goes on
            self.failure, done, self._running = str(error), None, None
            self._replaced = running.replaced if running else None
        if running and done:
            self._running, self._replaced = None, running.replaced
        return done

    def _begin(self) -> Correction | None:
        """The correction that waits, if it moves anything."""
        poses, self._waiting = self._waiting, None
        if poses is None or self.submaps is None:
            return None
        correction = Correction(self.config.correction, self.voxels, self.submaps, poses)
        return correction if correction.needed else None
