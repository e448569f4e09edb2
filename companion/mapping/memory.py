"""What of the map lies compressed: blocks go when they are far, and are back before a ray can meet them.

The map is cut into regions of 8 x 8 x 4 blocks. A region is either in the block store or cold:
compressed without loss, in memory or on a shelf. Each scan brings back every cold region that its rays can
reach, so that insertion never knows; then it fetches and puts away a bounded number.

    the ball that rays can reach    no cold region meets it, ever
    + keep_m / 2                    cold regions are fetched ahead, nearest first
    + keep_m                        what is farther is put away, farthest first
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Annotated

import msgspec
import numpy as np
from numba import njit
from numpy.typing import NDArray

from companion.mapping.blocks import BlockStore
from companion.mapping.cold_region import (
    SHAPE,
    Blocks,
    all_blocks,
    keys_of,
    places_of,
    positions_of,
    region_key,
    regions_of,
)
from companion.mapping.cold_store import Box, ColdStore
from companion.mapping.rays import BLOCK
from companion.mapping.sensor_model import UNKNOWN
from companion.mapping.shelf import Shelf

_RELAXED = 0.9  # of the budget: below, memory is no longer short
_FORGET_TO = 0.98  # of the budget: then the next scans need not forget
_NO_ROWS = np.empty(0, np.int64)


class MemoryConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """How much of the map lies uncompressed, and how large it may become."""

    keep_m: Annotated[float, msgspec.Meta(ge=0.0)] = 6.0  # beyond the longest ray, blocks stay as they are
    regions_per_scan: Annotated[int, msgspec.Meta(ge=1, le=10_000)] = 16  # put away, and fetched ahead, at most
    budget_mb: Annotated[float, msgspec.Meta(gt=0.0)] = 1024.0
    """Of map, 10^6 bytes, on a shelf or not. Beyond it, first `keep_m` counts as 0; then cold regions are forgotten:
    those farthest from both the vehicle and the first scan, those of a loaded map last."""
    spill: bool = True  # cold regions leave RAM for a temporary file, where the runtime offers one


class Memory:
    """Moves regions between the block store and compressed bytes."""

    def __init__(
        self,
        config: MemoryConfig,
        blocks: BlockStore,
        *,
        resolution_m: float,
        lowest: int,
        shelf: Shelf | None = None,
    ) -> None:
        self.config = config
        self.cold = ColdStore(shelf if config.spill else None, self._new_version)
        self._blocks = blocks
        self._lowest = lowest  # clamp of the log-odds
        self._keep = int(min(np.ceil(config.keep_m / (BLOCK * resolution_m)), 1 << 20))  # blocks
        self._asked: Box = (np.zeros(3, np.int64), np.zeros(3, np.int64))
        self._start: NDArray[np.int64] | None = None  # block of the first scan
        self._settled_at: tuple[int, ...] = ()  # block and reach of the last scan, if it left nothing to move
        self._scarce = False

    @property
    def memory_bytes(self) -> int:
        """Of cold regions, those on a shelf included: so the map does not depend on where they lie."""
        return self.cold.memory_bytes

    @property
    def spilled_bytes(self) -> int:
        """Of them, what lies on a shelf, and not in memory."""
        return self.cold.shelves.outside_bytes

    @property
    def cold_blocks(self) -> int:
        """How many blocks are cold."""
        return self.cold.blocks

    @property
    def cold_regions(self) -> int:
        """How many regions are cold."""
        return len(self.cold.regions)

    @property
    def forgotten_blocks(self) -> int:
        """Since the map began: what the budget cost, and what could not be read again."""
        return self.cold.forgotten_blocks

    def before_scan(self, here: NDArray[np.int64], reach: int) -> None:
        """Bring back all blocks of the ball of `reach` blocks around block `here` (3,); then move a few regions."""
        place = (*here.tolist(), reach)
        if place == self._settled_at:
            return
        self._start = here if self._start is None else self._start
        self._scarce = self._total() > self.config.budget_mb * 1e6 * (_RELAXED if self._scarce else 1.0)
        keep, few = 0 if self._scarce else self._keep, self.config.regions_per_scan
        near, away = _by_distance(self.cold.within(_around(here, reach + keep // 2)), here)
        must = int(np.searchsorted(away, reach**2, side="right"))
        ahead = int(np.searchsorted(away, (reach + keep // 2) ** 2, side="right"))
        self._wake(near[:must].tolist())
        self._wake(near[must : min(must + few, ahead)].tolist())
        moved = self._put_away(here, reach + keep, few)
        if self._scarce and moved < few:
            self._forget(here)
        settled = moved == 0 and ahead - must <= few and not self._scarce
        self._settled_at = place if settled else ()

    def bring_back(self, box: Box) -> None:
        """Make sure that all blocks of the box are in the store, and stay until another box is asked for."""
        self._asked = box
        self._wake(self.cold.within(box).tolist())

    def bring_back_seen(self, first_ns: int, last_ns: int) -> None:
        """Make sure that all blocks last seen in `first_ns` .. `last_ns` are in the store."""
        cold = self.cold.regions.items()
        self._wake(sorted(k for k, region in cold if region.seen_ns[0] <= last_ns and region.seen_ns[1] >= first_ns))

    def let_go(self, blocks: int) -> bool:
        """Drop about that many cold blocks, as the map is not used any more; False: there were none."""
        return self.cold.let_go(blocks)

    def at(self, cells: NDArray[np.int64], found: NDArray[np.int8]) -> None:
        """Fill in the log-odds `found` (N,) of `cells` (N, 3) that lie in cold regions."""
        where = np.flatnonzero(found == UNKNOWN) if self.cold.regions else _NO_ROWS
        for part, blocks in self._met(cells[where] >> 3):
            inside = cells[where[part]]
            row = np.searchsorted(places_of(blocks["xyz"]), places_of(inside >> 3))
            cell = (inside & 7) @ np.array([BLOCK * BLOCK, BLOCK, 1])
            there = _same_place(blocks, row, inside >> 3)
            found[where[part][there]] = blocks["log_odds"][row[there], cell[there]]

    def log_odds_of(self, block_xyz: NDArray[np.int64]) -> NDArray[np.int8]:
        """Log-odds (N, 512) of the blocks at (N, 3), cold or not; UNKNOWN where there is none."""
        rows = self._blocks.rows_of(block_xyz)
        found = self._blocks.log_odds[rows]
        missing = np.flatnonzero(rows < 0)
        found[missing] = UNKNOWN
        where = missing if self.cold.regions else _NO_ROWS
        for part, blocks in self._met(block_xyz[where]):
            row = np.searchsorted(places_of(blocks["xyz"]), places_of(block_xyz[where[part]]))
            there = _same_place(blocks, row, block_xyz[where[part]])
            found[where[part][there]] = blocks["log_odds"][row[there]]
        return found

    def changes_since(self, version: int) -> tuple[NDArray[np.int32], NDArray[np.int64]]:
        """`VoxelMap.changes_since` of the cold and forgotten blocks."""
        xyz, versions = self.cold.changes_since(version)
        if self.forgotten_blocks == 0:
            return xyz, versions
        gone = self._blocks.rows_of(xyz.astype(np.int64)) < 0
        return xyz[gone], versions[gone]

    def parts(self) -> Iterator[Blocks]:
        """The whole map, region by region in one order whatever is cold; the map must not change meanwhile."""
        xyz = self._blocks.xyz[: self._blocks.count]
        keys = keys_of(regions_of(xyz))
        order = np.lexsort((places_of(xyz), keys))
        ordered = keys[order]
        for key in np.union1d(ordered, np.array(list(self.cold.regions), np.int64)).tolist():
            first, last = np.searchsorted(ordered, [key, key + 1])
            warm = self._blocks.take(order[first:last]) if last > first else None
            part = _merged(warm, self.cold.read(key) if key in self.cold.regions else None)
            if part is not None:
                yield part

    def _total(self) -> int:
        return self._blocks.memory_bytes + self.cold.memory_bytes

    def _new_version(self) -> int:
        self._blocks.mark_changed(_NO_ROWS)
        return self._blocks.version

    def _wake(self, keys: Iterable[int]) -> None:
        """Back into the store."""
        for key in keys:
            blocks = self.cold.take(key)
            if blocks is not None:
                self._blocks.put(blocks, self._lowest)

    def _put_away(self, here: NDArray[np.int64], keep: int, most: int) -> int:
        """Compress up to `most` regions, the farthest first, that meet neither the ball nor what was asked for.

        Nor such ones where decay is at work: passes know only what is in the store.
        """
        blocks = self._blocks
        found = np.empty((2, blocks.count), np.int64)
        arrays = (blocks.xyz[: blocks.count], blocks.stirred)
        count, busy = _outside(arrays, here, keep, _whole_regions(self._asked), found)
        keys = np.setdiff1d(found[0, :count], found[1, :busy])
        keys = _by_distance(keys, here)[0][::-1][:most]
        gone = []
        for key in keys.tolist():
            self._wake([key] if key in self.cold.regions else [])  # someone added blocks to a cold region
            rows = blocks.rows_of(all_blocks(key))
            gone.append(rows[rows >= 0])
            self.cold.add(key, blocks.take(gone[-1]))
        if gone:
            blocks.remove(np.concatenate(gone))
        return len(gone)

    def _forget(self, here: NDArray[np.int64]) -> None:
        """Drop cold regions until the map fits the budget."""
        start = here if self._start is None else self._start
        regions = self.cold.regions
        far = _by_distance(np.array(sorted(regions), np.int64), here, start)[0][::-1]
        for key in sorted(far.tolist(), key=lambda key: regions[key].held):  # stable
            if self._total() <= _FORGET_TO * self.config.budget_mb * 1e6:
                break
            self.cold.forget(key)

    def _met(self, block_xyz: NDArray[np.int64]) -> Iterator[tuple[NDArray[np.int64], Blocks]]:
        """For each cold region with some of the blocks: which of them, and the region's blocks."""
        keys = keys_of(regions_of(block_xyz))
        order = np.argsort(keys, kind="stable")
        unique, first = np.unique(keys[order], return_index=True)
        for key, part in zip(unique.tolist(), np.split(order, first[1:]), strict=False):
            blocks = self.cold.read(key) if key in self.cold.regions else None
            if blocks is not None:
                yield part, blocks


def _around(here: NDArray[np.int64], reach: int) -> Box:
    return here - reach, here + reach + 1


def _whole_regions(box: Box) -> Box:
    """The box of all regions that it meets, in blocks."""
    low, high = regions_of(box[0]), regions_of(box[1] - 1) + 1
    return low * SHAPE, high * SHAPE


def _by_distance(keys: NDArray[np.int64], *places: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Regions, those nearest to any of the blocks `places` first, then by key; and their distances, squared.

    The distance to a region is that to the nearest block that it can have.
    """
    low = positions_of(keys) * SHAPE
    gaps = [np.maximum(np.maximum(low - place, place - low - SHAPE + 1), 0) for place in places]
    away = np.min([np.sum(gap * gap, axis=1) for gap in gaps], axis=0)
    order = np.lexsort((keys, away))
    return keys[order], away[order]


def _same_place(blocks: Blocks, row: NDArray[np.int64], block_xyz: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Whether (N,) the blocks' `row`, as `searchsorted` gave it, holds the block at (N, 3); clips `row`."""
    np.minimum(row, len(blocks["xyz"]) - 1, out=row)
    return np.asarray(np.all(blocks["xyz"][row] == block_xyz, axis=1))


def _merged(warm: Blocks | None, cold: Blocks | None) -> Blocks | None:
    """Both parts of a region, in order of the places."""
    if warm is None or cold is None:
        return warm or cold
    both = {name: np.concatenate([warm[name], cold[name]]) for name in warm}
    order = np.argsort(places_of(both["xyz"]))
    return {name: array[order] for name, array in both.items()}


@njit(cache=True, nogil=True)
def _outside(arrays, here, keep, asked, keys):  # type: ignore[no-untyped-def]
    """Write the key of the region of each block if it meets neither the ball nor the box; then those of stirred ones.

    Returns how many of both.
    """
    (xyz, stirred), (low, high) = arrays, asked
    count = busy = 0
    for n in range(xyz.shape[0]):
        away, inside = 0, True
        for axis in range(3):
            at, size = np.int64(xyz[n, axis]), SHAPE[axis]
            first = at - at % size
            gap = max(first - here[axis], here[axis] - first - size + 1, 0)
            away += gap * gap
            inside &= low[axis] <= at < high[axis]
        if away > keep * keep and not inside:
            keys[0, count] = region_key(xyz[n, 0], xyz[n, 1], xyz[n, 2])
            count += 1
            if stirred[n] != 0:
                keys[1, busy] = keys[0, count - 1]
                busy += 1
    return count, busy
