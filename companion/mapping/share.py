"""What the bus is told of the map beside the local one: occupied voxels, changes, now and then the whole."""

from __future__ import annotations

from typing import Annotated

import msgspec
import numpy as np
from numba import njit

from companion.core.messages import Array, Array32, OccupiedVoxels
from companion.core.node import Outputs
from companion.core.topics import MAP_DELTA, MAP_FULL, OCCUPIED
from companion.mapping.deltas import FullWalk, delta_since, records_of
from companion.mapping.rays import BLOCK
from companion.mapping.voxel_map import VoxelMap

_SIGNS = 0x8080808080808080
_Scans = Annotated[int, msgspec.Meta(ge=0)]
u64 = np.uint64


class ShareConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """How often the map goes to others, in scans (10 a second); 0: never. Nothing goes that did not change."""

    occupied_every: _Scans = 5  # scans per cloud of occupied voxels, for viewers
    occupied_radius_m: Annotated[float, msgspec.Meta(gt=0.0)] = 30.0
    """Around the vehicle, at most the map's `max_range_m`: so far, nothing is ever put away."""
    delta_every: _Scans = 10  # scans per delta
    delta_blocks: Annotated[int, msgspec.Meta(ge=1)] = 8192
    """Of a delta, about: after a correction the whole map may have changed, which is told scan by scan."""
    full_every: _Scans = 50  # scans from one whole map to the next, at least
    full_blocks_per_scan: Annotated[int, msgspec.Meta(ge=1)] = 250  # packed per scan: bounds the work of a whole map


class MapShare:
    """Makes the messages; call `after_scan` after every scan.

    >>> share = MapShare(ShareConfig())
    >>> for output in share.after_scan(voxels, p_odom, stamp_ns=stamp_ns): ...
    """

    def __init__(self, config: ShareConfig) -> None:
        self.config = config
        self._scans = 0
        self._map_ns = 0  # stamp of the first scan
        self._more = False  # the last delta did not tell all
        self._walk: FullWalk | None = None
        self._shown = self._told = self._whole = 0  # version of the last cloud, delta, whole map
        self._next_whole = 0  # scan from which on

    def after_scan(self, voxels: VoxelMap, p_odom: Array, *, stamp_ns: int) -> Outputs:
        """What is to be published now; the vehicle is at `p_odom` (3,)."""
        if self._scans == 0:
            self._map_ns = stamp_ns
        if self._due(self.config.occupied_every) and len(voxels.changed_since(self._shown)):
            self._shown = voxels.version
            radius_m = min(self.config.occupied_radius_m, voxels.config.max_range_m)
            points, log_odds = occupied_near(voxels, p_odom, radius_m)
            yield OCCUPIED(OccupiedVoxels(stamp_ns=stamp_ns, points_odom=points, log_odds=log_odds))
        if self._due(self.config.delta_every) or self._more:
            delta = delta_since(
                voxels, self._told, stamp_ns=stamp_ns, map_ns=self._map_ns, most=self.config.delta_blocks
            )
            if delta is not None:
                self._told, self._more = delta.version_to, delta.version_to < voxels.version
                yield MAP_DELTA(delta)
        if self.config.full_every:
            yield from self._advance(voxels, stamp_ns)
        self._scans += 1

    def _due(self, every: int) -> bool:
        return every > 0 and self._scans % every == 0

    def _advance(self, voxels: VoxelMap, stamp_ns: int) -> Outputs:
        if self._walk is None and self._scans >= self._next_whole and len(voxels.changed_since(self._whole)):
            self._walk = FullWalk(voxels, map_ns=self._map_ns)
            self._next_whole = self._scans + self.config.full_every
        if self._walk is None:
            return
        full = self._walk.advance(voxels, blocks=self.config.full_blocks_per_scan, stamp_ns=stamp_ns)
        if full is not None:
            self._walk, self._whole = None, full.version_to
            yield MAP_FULL(full)


def warm_share(voxels: VoxelMap) -> None:
    """Compile what `MapShare` needs."""
    occupied_near(voxels, np.zeros(3), 1.0)
    records_of(voxels, np.zeros((0, 3), np.int32))


def occupied_near(voxels: VoxelMap, p_odom: Array, radius_m: float) -> tuple[Array32, Array32]:
    """Centres (N, 3), m, and log-odds (N,) of the occupied voxels of blocks nearer than `radius_m` to `p_odom` (3,).

    In the order of the store, and without what lies in cold memory; a block is as near as its centre.
    """
    blocks = voxels.blocks
    center = p_odom / (BLOCK * voxels.resolution_m) - 0.5
    gap = blocks.xyz[: blocks.count] - center.astype(np.float32)
    reach = np.float32(radius_m / (BLOCK * voxels.resolution_m))
    rows = np.flatnonzero(np.einsum("ij,ij->i", gap, gap) < reach * reach)
    words = blocks.log_odds.view(np.uint64)
    found = int(_count_occupied(words, rows))
    points, log_odds = np.empty((found + 1, 3), np.float32), np.empty(found + 1, np.float32)
    scales = np.array([voxels.resolution_m, 1.0 / voxels.steps.per_unit])
    _list_occupied(words, (rows, blocks.xyz), scales, points, log_odds)
    return points[:found], log_odds[:found]


@njit(cache=True, nogil=True)
def _count_occupied(words, rows):  # type: ignore[no-untyped-def]
    """Cells whose sign bit is clear."""
    count = u64(0)
    for n in range(rows.size):
        for w in range(words.shape[1]):
            signs = (~words[rows[n], w] & u64(_SIGNS)) >> u64(7)
            count += (signs * u64(0x0101010101010101)) >> u64(56)
    return count


@njit(cache=True, nogil=True)
def _list_occupied(words, where, scales, points, log_odds):  # type: ignore[no-untyped-def]
    """Every cell of a word is written, and written over by the next if it is not occupied: no branch to guess."""
    rows, xyz = where
    cell_m, per_step = scales[0], scales[1]
    found = 0
    for n in range(rows.size):
        row = rows[n]
        x0, y0, z0 = BLOCK * xyz[row, 0] + 0.5, BLOCK * xyz[row, 1] + 0.5, BLOCK * xyz[row, 2] + 0.5
        for w in range(words.shape[1]):
            word = words[row, w]
            if word & u64(_SIGNS) == u64(_SIGNS):
                continue
            x, y = np.float32((x0 + (w >> 3)) * cell_m), np.float32((y0 + (w & 7)) * cell_m)
            for k in range(BLOCK):
                level = (word >> u64(8 * k)) & u64(0xFF)
                points[found, 0], points[found, 1], points[found, 2] = x, y, (z0 + k) * cell_m
                log_odds[found] = level * per_step
                found += level < u64(0x80)
