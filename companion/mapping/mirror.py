"""A map somewhere else, kept by the messages of `mapping/full` and `mapping/delta`, whatever was lost of them."""

from __future__ import annotations

import numpy as np

from companion.core.errors import InputError
from companion.core.messages import MapDelta
from companion.mapping.deltas import Records, states_of, unpack
from companion.mapping.sensor_model import UNKNOWN
from companion.mapping.voxel_map import VoxelMap, VoxelMapConfig

_MOST_WAITING = 512  # deltas; what is older than that a full map will replace
_FINEST_M, _COARSEST_M = 0.02, 2.0  # as VoxelMapConfig has it


class MapMirror:
    """The receiver's map. Its classes are those of the sender at `version`; log-odds are the clamps.

    >>> mirror = MapMirror()
    >>> for message in messages: mirror.take(message)  # of both topics, in any order
    >>> mirror.current, mirror.voxels.classify(points)

    `voxels` is None until the first message that could be used, and another object only when
    the sender began a new map. `gaps` counts how often a delta came after one that was lost.
    """

    def __init__(self) -> None:
        self.voxels: VoxelMap | None = None
        self.version = 0
        self.gaps = 0
        self._map: tuple[int, float] | None = None  # which map: stamp of its first scan, resolution
        self._waiting: list[MapDelta] = []  # a gap before them

    @property
    def current(self) -> bool:
        """Whether nothing is known to be missing up to the newest message."""
        return self.voxels is not None and not self._waiting

    def take(self, delta: MapDelta) -> bool:
        """Take in one message; returns `current`. Raises InputError, and changes nothing, if it is damaged."""
        if not _FINEST_M <= delta.resolution_m <= _COARSEST_M:
            raise InputError(f"{delta.resolution_m} m", field="resolution_m", valid=f"{_FINEST_M} to {_COARSEST_M:g} m")
        which = (delta.map_ns, delta.resolution_m)
        if which == self._map and delta.version_to <= self.version:
            return self.current
        records = unpack(delta)
        if which != self._map:
            self._map, self.voxels, self.version, self._waiting = which, None, 0, []
        if delta.version_from > self.version:
            self._wait(delta)
        else:
            self._apply(delta, records)
            self._catch_up()
        return self.current

    def _wait(self, delta: MapDelta) -> None:
        self.gaps += self.current
        self._waiting = [*self._waiting, delta][-_MOST_WAITING:]

    def _catch_up(self) -> None:
        """Apply what waited, in order, up to the next gap."""
        for delta in sorted(self._waiting, key=lambda d: d.version_to):
            if delta.version_from <= self.version < delta.version_to:
                self._apply(delta, unpack(delta))
        self._waiting = [d for d in self._waiting if d.version_to > self.version]

    def _apply(self, delta: MapDelta, records: Records) -> None:
        if self.voxels is None:
            cell_m = delta.resolution_m
            self.voxels = VoxelMap(
                VoxelMapConfig(resolution_m=cell_m, max_range_m=8 * cell_m, miss_clear_range_m=8 * cell_m)
            )
        _write(self.voxels, records, whole=delta.version_from == 0)
        self.version = delta.version_to


def _write(voxels: VoxelMap, records: Records, *, whole: bool) -> None:
    """Give the blocks of the records their states; `whole`: all others are unknown."""
    steps, blocks = voxels.steps, voxels.blocks
    log_odds = np.array([UNKNOWN, steps.lowest, steps.highest], np.int8)[states_of(records)]
    rows = blocks.rows_of(records["xyz"].astype(np.int64))
    known = np.flatnonzero(rows >= 0)
    differ = known[np.any(blocks.log_odds[rows[known]] != log_odds[known], axis=1)]
    blocks.write(rows[differ], log_odds[differ], steps.lowest)
    if whole:
        others = np.setdiff1d(np.arange(blocks.count), rows[known], assume_unique=True)
        left = others[np.any(blocks.log_odds[others] != UNKNOWN, axis=1)]
        blocks.write(left, np.full((len(left), log_odds.shape[1]), UNKNOWN, np.int8), steps.lowest)
    new = rows < 0
    blocks.add(records["xyz"][new], log_odds[new], steps.lowest, held=False)
