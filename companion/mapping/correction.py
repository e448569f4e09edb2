"""The map follows when the pose graph corrects past poses (loop closure), beside insertion.

A second map is built in bounded steps: the evidence of each stretch of the flight, moved to
where the corrected poses put it, is added up. Meanwhile scans go on into the present map. Then
both are compared, so that others can be told what changes. In the last step the newest scans are
added, too, and the second map takes the place of the first.
The same idea with other means: V. Reijgwart et al., "Voxgraph", RA-L 2020 (submaps as signed
distances, aligned by a pose graph).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

import msgspec
import numpy as np

from companion.mapping.cold_region import unpack
from companion.mapping.comparison import Comparison, any_known
from companion.mapping.evidence import added
from companion.mapping.moved_blocks import MovedBlocks
from companion.mapping.pose_track import PoseCorrector, PoseShift
from companion.mapping.sensor_model import UNKNOWN
from companion.mapping.submaps import Evidence, Submap, SubmapConfig, Submaps
from companion.mapping.voxel_map import VoxelMap, VoxelMapConfig

_LEAP = 1 << 40  # versions: more than insertion makes while a correction runs
_PART = 2048  # blocks at a time: 1 MB, which a cache holds
_LOOKS = 8  # blocks are compared in the time that one is added
_STAY = PoseShift(np.eye(3), np.zeros(3))


class CorrectionConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """When the map follows, and how much of the work each scan does."""

    blocks_per_scan: Annotated[int, msgspec.Meta(ge=1)] = 8192  # of 8^3 voxels, moved and added up
    least_shift: Annotated[float, msgspec.Meta(ge=0.0, le=10.0)] = 0.5  # voxels: what moves less stays


@dataclass(frozen=True, slots=True)
class Corrected:
    """What a correction did."""

    moved: int  # stretches that came to lie elsewhere
    stayed: int  # bit by bit
    blocks: int  # of the map now
    changed: int  # blocks in which a voxel changed its class
    work: int  # blocks that were moved and added up


class Correction:
    """One correction of `voxels`; `advance` until it returns what was done.

    >>> correction = Correction(config, voxels, submaps, PoseCorrector(submaps.track, stamps_ns, p, q))
    >>> while (done := correction.advance()) is None:
    ...     voxels.insert(...)  # insertion goes on
    """

    def __init__(self, config: CorrectionConfig, voxels: VoxelMap, submaps: Submaps, poses: PoseCorrector) -> None:
        self.config = config
        self._voxels, self._submaps, self._poses = voxels, submaps, poses
        self._second = voxels.blank()
        self._least = self._second.blocks.version = voxels.version + _LEAP  # whatever is in it counts as changed
        self._loaded = self._next = self._opened = self._moved = self._work = 0
        self._now: MovedBlocks | None = None
        self._first = 0  # block of `_now` that comes next
        self._last_ns = 0
        self._comparison: Comparison | None = None
        self._comparing = True
        self._newest: Submap | None = None  # that was added before it was packed

    @property
    def replaced(self) -> VoxelMap:
        """Once all is done: the map that was, which nobody needs."""
        return self._second

    @property
    def needed(self) -> bool:
        """Whether anything at rest moves by more than `least_shift`."""
        return any(self._shift(submap) is not _STAY for submap in self._submaps.closed)

    def advance(self) -> Corrected | None:
        """One bounded step; None: there is more to do. Raises OSError: a stretch cannot be read any more."""
        left = self.config.blocks_per_scan
        self._submaps.joining = False  # stretches are counted
        self._keep_small()
        while left > 0:
            if self._now is not None:
                left -= self._add(min(left, _PART))
            elif self._loaded < len(self._submaps.loaded):
                left -= self._take_loaded()
            elif self._next < len(self._submaps.closed):
                self._open(self._submaps.closed[self._next])
                self._next += 1
                return None  # that was work enough
            else:
                return self._end()
        return None

    def _shift(self, submap: Submap) -> PoseShift:
        """How a stretch moves."""
        shift = self._poses.shift_at(submap.anchor_ns)
        _, p = self._submaps.track.at(submap.anchor_ns)
        reach_m = 0.5 * self._voxels.config.max_range_m
        least_m = self.config.least_shift * self._voxels.resolution_m
        return shift if shift.size_m(p, reach_m) > least_m else _STAY

    def _take_loaded(self) -> int:
        """One region of a loaded map, which stays where it is."""
        key, region = self._submaps.loaded[self._loaded]
        self._second.blocks.put(unpack(region, key), self._voxels.steps.lowest)
        self._loaded += 1
        return region.count

    def _open(self, submap: Submap, evidence: Evidence | None = None) -> None:
        """Move a stretch; its blocks are added by `_add`."""
        shift = self._shift(submap)
        xyz, values = evidence or self._submaps.evidence(submap)
        self._now = MovedBlocks(xyz, values, shift, self._voxels.resolution_m)
        self._first, self._last_ns = 0, submap.last_ns
        self._moved += shift is not _STAY
        self._opened += 1
        self._keep_small()

    def _keep_small(self) -> None:
        """Put away what of the second map is far from the stretch at hand, once the map takes half its budget."""
        memory = self._second.memory
        large = self._second.memory_bytes > 0.5e6 * memory.config.budget_mb
        if self._now is not None and len(self._now.xyz) and (large or memory.cold_regions):
            low, high = self._now.xyz.min(axis=0).astype(np.int64), self._now.xyz.max(axis=0).astype(np.int64)
            here = (low + high) // 2
            memory.before_scan(here, math.ceil(np.linalg.norm(high - here)) + 1)

    def _add(self, count: int) -> int:
        """Add up to `count` blocks of the stretch at hand to the second map; returns how many."""
        assert self._now is not None
        first, last = self._first, min(self._first + count, len(self._now.xyz))
        values, xyz = self._now.cells(first, last), self._now.xyz[first:last]
        known = np.flatnonzero(any_known(values))
        values, xyz = values[known], xyz[known]
        blocks, steps = self._second.blocks, self._voxels.steps
        rows = blocks.rows_of(xyz.astype(np.int64))
        levels = np.full(values.shape, UNKNOWN, np.int8)
        old = np.flatnonzero(rows >= 0)
        levels[old] = blocks.log_odds[rows[old]]
        levels = added(levels, values, (steps.lowest, steps.highest))
        new = np.flatnonzero(rows < 0)
        blocks.write(rows[old], levels[old], steps.lowest)
        rows[new] = np.arange(blocks.count, blocks.count + len(new))
        blocks.add(xyz[new], levels[new], steps.lowest, held=False)
        blocks.seen_ns[rows] = np.maximum(blocks.seen_ns[rows], self._last_ns)
        self._first = last
        self._work += last - first
        if last == len(self._now.xyz):
            self._now = None
        return max(last - first, 1)

    def _end(self) -> Corrected | None:
        """The last steps, once all stretches at rest are added."""
        submaps = self._submaps
        if self._comparison is None:
            if not submaps.settled:
                return None
            if submaps.open_blocks > self.config.blocks_per_scan:  # too many for one step
                self._open_newest()
            self._comparison = Comparison(self._voxels, self._second)
            return None
        if self._comparing:
            self._comparing = self._comparison.advance(_LOOKS * self.config.blocks_per_scan)
            return None
        return self._finish() if submaps.waits_only_for(self._newest) else None

    def _open_newest(self) -> None:
        """End the open stretch, and move it before it is packed."""
        closed = self._submaps.close()
        if closed is not None:
            self._newest = closed[0]
            self._next += 1  # as it is then
            self._open(*closed)

    def _finish(self) -> Corrected:
        """Add the open stretch, and put the second map in the place of the first."""
        assert self._comparison is not None
        self._open_newest()
        while self._now is not None:
            self._add(_PART)
        self._comparison.finish()
        new = self._second.blocks
        changed = np.count_nonzero(new.changed_at[: new.count] >= self._least) + self._second.memory.cold_blocks
        self._voxels.swap(self._second)
        self._submaps.joining = True
        blocks = self._voxels.block_count
        return Corrected(self._moved, self._opened - self._moved, blocks, int(changed), self._work)


def warm_correction(config: VoxelMapConfig) -> None:
    """Compile all kernels of submaps and corrections, on a map of two voxels."""
    voxels = VoxelMap(config)
    submaps = Submaps(SubmapConfig(), voxels)
    points = np.array([[1.0, 0.0, 0.0]], np.float32)
    here, turned = np.array([0.1, 0.1, 0.1]), np.array([[1.0, 0.0, 0.0, 0.0], [0.8, 0.0, 0.0, 0.6]])
    for stamp_ns in range(2):
        voxels.insert(points, R_odom_body=np.eye(3), p_odom=here, origin_odom=here, watch=submaps.watch)
        submaps.after_scan(stamp_ns, here, turned[0])
        submaps.close()
    submaps.after_scan(2, here, turned[0])
    poses = PoseCorrector(submaps.track, np.arange(2), np.stack([here, here]), turned)
    correction = Correction(CorrectionConfig(), voxels, submaps, poses)
    while correction.advance() is None:
        pass
