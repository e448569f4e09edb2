"""What of the map lies compressed: blocks go when they are far, and are back before a ray can meet them.

The map is cut into regions of 8 x 8 x 4 blocks. A region is either in the block store or cold:
compressed without loss, in memory. Each scan brings back every cold region that its rays can
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
    ColdRegion,
    all_blocks,
    keys_of,
    pack,
    places_of,
    positions_of,
    region_key,
    regions_of,
    unpack,
    unpack_rest,
    xyz_of,
)
from companion.mapping.rays import BLOCK, CELLS
from companion.mapping.sensor_model import UNKNOWN

_RELAXED = 0.9  # of the budget: below, memory is no longer short
_FORGET_TO = 0.98  # of the budget: then the next scans need not forget
_TABLE_BYTES = 120  # of a cold region's entry
Box = tuple[NDArray[np.int64], NDArray[np.int64]]  # lowest block, block beyond the highest


class MemoryConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """How much of the map lies uncompressed, and how large it may become."""

    keep_m: Annotated[float, msgspec.Meta(ge=0.0)] = 6.0  # beyond the longest ray, blocks stay as they are
    regions_per_scan: Annotated[int, msgspec.Meta(ge=1, le=10_000)] = 16  # put away, and fetched ahead, at most
    budget_mb: Annotated[float, msgspec.Meta(gt=0.0)] = 1024.0
    """Of map, 10^6 bytes. Beyond it, first `keep_m` counts as 0; then cold regions are forgotten:
    those farthest from both the vehicle and the first scan, those of a loaded map last."""


class Memory:
    """Moves regions between the block store and compressed bytes."""

    def __init__(self, config: MemoryConfig, blocks: BlockStore, *, resolution_m: float, lowest: int) -> None:
        self.config = config
        self.cold_blocks = 0
        self.forgotten_blocks = 0  # since the map began: what the budget cost
        self._blocks = blocks
        self._lowest = lowest  # clamp of the log-odds
        self._keep = int(min(np.ceil(config.keep_m / (BLOCK * resolution_m)), 1 << 20))  # blocks
        self._cold: dict[int, ColdRegion] = {}
        self._cold_bytes = 0
        self._newest = -1  # no cold block changed after this version
        self._asked: Box = (np.zeros(3, np.int64), np.zeros(3, np.int64))
        self._start: NDArray[np.int64] | None = None  # block of the first scan
        self._scarce = False

    @property
    def memory_bytes(self) -> int:
        """Of cold regions."""
        return self._cold_bytes

    @property
    def cold_regions(self) -> int:
        """How many regions are cold."""
        return len(self._cold)

    def before_scan(self, here: NDArray[np.int64], reach: int) -> None:
        """Bring back all blocks of the ball of `reach` blocks around block `here` (3,); then move a few regions."""
        self._start = here if self._start is None else self._start
        self._scarce = self._total() > self.config.budget_mb * 1e6 * (_RELAXED if self._scarce else 1.0)
        keep, few = 0 if self._scarce else self._keep, self.config.regions_per_scan
        near, away = _by_distance(self._cold_in(_around(here, reach + keep // 2)), here)
        must = int(np.searchsorted(away, reach**2, side="right"))
        ahead = int(np.searchsorted(away, (reach + keep // 2) ** 2, side="right"))
        self._wake(near[:must].tolist())
        self._wake(near[must : min(must + few, ahead)].tolist())
        moved = self._put_away(here, reach + keep, few)
        if self._scarce and moved < few:
            self._forget(here)

    def bring_back(self, box: Box) -> None:
        """Make sure that all blocks of the box are in the store, and stay until another box is asked for."""
        self._asked = box
        self._wake(self._cold_in(box).tolist())

    def at(self, cells: NDArray[np.int64], found: NDArray[np.int8]) -> None:
        """Fill in the log-odds `found` (N,) of `cells` (N, 3) that lie in cold regions."""
        where = np.flatnonzero(found == UNKNOWN) if self._cold else np.empty(0, np.int64)
        for part, blocks in self._met(cells[where] >> 3):
            inside = cells[where[part]]
            row = np.searchsorted(places_of(blocks["xyz"]), places_of(inside >> 3))
            cell = (inside & 7) @ np.array([BLOCK * BLOCK, BLOCK, 1])
            there = _same_place(blocks, row, inside >> 3)
            found[where[part][there]] = blocks["log_odds"][row[there], cell[there]]

    def log_odds_of(self, block_xyz: NDArray[np.int64]) -> NDArray[np.int8]:
        """Log-odds (N, 512) of the blocks at (N, 3), cold or not; UNKNOWN where there is none."""
        rows = self._blocks.rows_of(block_xyz)
        found = np.full((len(rows), CELLS), UNKNOWN, np.int8)
        found[rows >= 0] = self._blocks.log_odds[rows[rows >= 0]]
        where = np.flatnonzero(rows < 0) if self._cold else np.empty(0, np.int64)
        for part, blocks in self._met(block_xyz[where]):
            row = np.searchsorted(places_of(blocks["xyz"]), places_of(block_xyz[where[part]]))
            there = _same_place(blocks, row, block_xyz[where[part]])
            found[where[part][there]] = blocks["log_odds"][row[there]]
        return found

    def changed_since(self, version: int) -> NDArray[np.int32]:
        """Positions (K, 3) of cold blocks in which a voxel changed its class after `version`."""
        parts = [np.empty((0, 3), np.int32)]
        some = [k for k, region in self._cold.items() if region.changes[1] > version] if self._newest > version else []
        for key in sorted(some):
            region, xyz = self._cold[key], xyz_of(self._cold[key], key)
            all_of_it = region.changes[0] > version
            parts.append(xyz if all_of_it else xyz[unpack_rest(region)["changed_at"] > version])
        return np.concatenate(parts)

    def parts(self) -> Iterator[Blocks]:
        """The whole map, region by region in one order whatever is cold; the map must not change meanwhile."""
        xyz = self._blocks.xyz[: self._blocks.count]
        keys = keys_of(regions_of(xyz))
        order = np.lexsort((places_of(xyz), keys))
        ordered = keys[order]
        for key in np.union1d(ordered, np.array(list(self._cold), np.int64)).tolist():
            first, last = np.searchsorted(ordered, [key, key + 1])
            region = self._cold.get(key)
            warm = self._blocks.take(order[first:last]) if last > first else None
            yield _merged(warm, unpack(region, key) if region else None)

    def _total(self) -> int:
        return self._blocks.memory_bytes + self._cold_bytes

    def _cold_in(self, box: Box) -> NDArray[np.int64]:
        """Keys of the cold regions that meet the box, ascending."""
        low, high = regions_of(box[0]), regions_of(box[1] - 1) + 1
        if np.prod(high - low) > len(self._cold):
            keys = np.array(sorted(self._cold), np.int64)
            return keys[_meets(keys, box)]
        axes = [np.arange(a, b) for a, b in zip(low, high, strict=True)]
        regions = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
        return np.array([key for key in keys_of(regions).tolist() if key in self._cold], np.int64)

    def _wake(self, keys: Iterable[int]) -> None:
        """Back into the store."""
        for key in keys:
            self._blocks.put(unpack(self._drop(key), key), self._lowest)

    def _put_away(self, here: NDArray[np.int64], keep: int, most: int) -> int:
        """Compress up to `most` regions, the farthest first, that meet neither the ball nor what was asked for."""
        found = np.empty(self._blocks.count, np.int64)
        count = _outside(self._blocks.xyz[: self._blocks.count], here, keep, _whole_regions(self._asked), found)
        keys = _by_distance(np.unique(found[:count]), here)[0][::-1][:most]
        gone = []
        for key in keys.tolist():
            self._wake([key] if key in self._cold else [])  # someone added blocks to a cold region
            rows = self._blocks.rows_of(all_blocks(key))
            gone.append(rows[rows >= 0])
            self._keep_cold(key, pack(self._blocks.take(gone[-1])))
        if gone:
            self._blocks.remove(np.concatenate(gone))
        return len(gone)

    def _forget(self, here: NDArray[np.int64]) -> None:
        """Drop cold regions until the map fits the budget."""
        start = here if self._start is None else self._start
        far = _by_distance(np.array(sorted(self._cold), np.int64), here, start)[0][::-1]
        for key in sorted(far.tolist(), key=lambda key: self._cold[key].held):  # stable
            if self._total() <= _FORGET_TO * self.config.budget_mb * 1e6:
                break
            self.forgotten_blocks += self._drop(key).count

    def _keep_cold(self, key: int, region: ColdRegion) -> None:
        self._cold[key] = region
        self._newest = max(self._newest, region.changes[1])
        self.cold_blocks += region.count
        self._cold_bytes += region.memory_bytes + _TABLE_BYTES

    def _drop(self, key: int) -> ColdRegion:
        region = self._cold.pop(key)
        self.cold_blocks -= region.count
        self._cold_bytes -= region.memory_bytes + _TABLE_BYTES
        return region

    def _met(self, block_xyz: NDArray[np.int64]) -> Iterator[tuple[NDArray[np.int64], Blocks]]:
        """For each cold region with some of the blocks: which of them, and the region's blocks."""
        keys = keys_of(regions_of(block_xyz))
        order = np.argsort(keys, kind="stable")
        unique, first = np.unique(keys[order], return_index=True)
        for key, part in zip(unique.tolist(), np.split(order, first[1:]), strict=False):
            if key in self._cold:
                yield part, unpack(self._cold[key], key)


def _around(here: NDArray[np.int64], reach: int) -> Box:
    return here - reach, here + reach + 1


def _whole_regions(box: Box) -> Box:
    """The box of all regions that it meets, in blocks."""
    low, high = regions_of(box[0]), regions_of(box[1] - 1) + 1
    return low * SHAPE, high * SHAPE


def _meets(keys: NDArray[np.int64], box: Box) -> NDArray[np.bool_]:
    """Which (N,) of the regions meet the box."""
    low, high = regions_of(box[0]), regions_of(box[1] - 1) + 1
    at = positions_of(keys)
    return np.asarray(np.all((at >= low) & (at < high), axis=1))


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


def _merged(warm: Blocks | None, cold: Blocks | None) -> Blocks:
    """Both parts of a region, in order of the places."""
    if warm is None or cold is None:
        return (warm or cold) or {}
    both = {name: np.concatenate([warm[name], cold[name]]) for name in warm}
    order = np.argsort(places_of(both["xyz"]))
    return {name: array[order] for name, array in both.items()}


@njit(cache=True, nogil=True)
def _outside(xyz, here, keep, asked, keys):  # type: ignore[no-untyped-def]
    """Write the key of the region of each block if it meets neither the ball nor the box; returns how many."""
    low, high = asked
    count = 0
    for n in range(xyz.shape[0]):
        away, inside = 0, True
        for axis in range(3):
            at, size = np.int64(xyz[n, axis]), SHAPE[axis]
            first = at - at % size
            gap = max(first - here[axis], here[axis] - first - size + 1, 0)
            away += gap * gap
            inside &= low[axis] <= at < high[axis]
        if away > keep * keep and not inside:
            keys[count] = region_key(xyz[n, 0], xyz[n, 1], xyz[n, 2])
            count += 1
    return count
