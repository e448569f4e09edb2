"""The cold regions of a map: compressed, by position, their bytes on a shelf if there is one."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from companion.mapping.cold_region import (
    Blocks,
    ColdRegion,
    blocks_at,
    keys_of,
    pack,
    positions_of,
    regions_of,
    unpack,
    unpack_rest,
    xyz_of,
)
from companion.mapping.shelf import Shelf, Shelves

Box = tuple[NDArray[np.int64], NDArray[np.int64]]  # lowest block, block beyond the highest
_GONE_BYTES = 200  # of what is kept of a forgotten region


class ColdStore:
    """Regions by their keys.

    `regions` have no data of their own: `read` and `take` fetch it. A region whose data cannot be
    read any more is forgotten. `new_version` counts a change of the map and returns its version.
    """

    def __init__(self, shelf: Shelf | None, new_version: Callable[[], int]) -> None:
        self.regions: dict[int, ColdRegion] = {}
        self.blocks = 0
        self.memory_bytes = 0  # as if nothing lay on a shelf
        self.forgotten_blocks = self.lost_blocks = 0  # in all; those of them that could not be read
        self.shelves = Shelves(shelf)
        self._new_version = new_version
        self._numbers: dict[int, int] = {}  # on the shelves
        self._newest = -1  # no block changed after this version
        self._gone: dict[int, tuple[int, bytes]] = {}  # forgotten: in which version, which places

    def within(self, box: Box) -> NDArray[np.int64]:
        """Keys of the regions that meet the box, ascending."""
        low, high = regions_of(box[0]), regions_of(box[1] - 1) + 1
        if np.prod(high - low) > len(self.regions):
            keys = np.array(sorted(self.regions), np.int64)
            at = positions_of(keys)
            return keys[np.all((at >= low) & (at < high), axis=1)]
        axes = [np.arange(a, b) for a, b in zip(low, high, strict=True)]
        every = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
        return np.array([key for key in keys_of(every).tolist() if key in self.regions], np.int64)

    def add(self, key: int, blocks: Blocks) -> None:
        """Put a region away."""
        region = pack(blocks)
        self._numbers[key] = self.shelves.put(region.data)
        self.regions[key] = replace(region, data=b"")
        self._newest = max(self._newest, region.changes[1])
        self.blocks += region.count
        self.memory_bytes += region.memory_bytes

    def read(self, key: int) -> Blocks | None:
        """The blocks of a region, which stays; None: they were lost just now."""
        region = self._whole(key)
        return unpack(region, key) if region else None

    def take(self, key: int) -> Blocks | None:
        """The blocks of a region, which does not stay; None: they were lost just now."""
        blocks = self.read(key)
        if blocks is not None:
            self._drop(key)
        return blocks

    def forget(self, key: int) -> None:
        """Drop a region; the map's next version tells of it."""
        region = self._drop(key)
        self.forgotten_blocks += region.count
        before = self._gone.get(key)
        places = np.frombuffer(region.places, np.uint8)
        if before is not None:
            places = places | np.frombuffer(before[1], np.uint8)
        else:
            self.memory_bytes += _GONE_BYTES
        self._newest = self._new_version()
        self._gone[key] = (self._newest, places.tobytes())

    def let_go(self, blocks: int) -> bool:
        """Drop about that many blocks; False: there were none."""
        least = self.blocks - blocks
        while self.regions and self.blocks > least:
            self._drop(next(reversed(self.regions)))
        return least > -blocks

    def changes_since(self, version: int) -> tuple[NDArray[np.int32], NDArray[np.int64]]:
        """Positions (K, 3) of blocks that changed after `version`, and those (of other blocks) forgotten since.

        For each the version (K,) of that, or one between: not all data is fetched for it.
        """
        parts, versions = [np.empty((0, 3), np.int32)], [np.empty(0, np.int64)]
        if self._newest <= version:
            return parts[0], versions[0]
        for key in sorted(key for key, region in self.regions.items() if region.changes[1] > version):
            xyz, changed_at = self._changes(key, version)
            parts.append(xyz)
            versions.append(changed_at)
        for key in sorted(key for key, gone in self._gone.items() if gone[0] > version):
            places = np.frombuffer(self._gone[key][1], np.uint8)
            if key in self.regions:
                places = places & ~np.frombuffer(self.regions[key].places, np.uint8)
            parts.append(blocks_at(places.tobytes(), key))
            versions.append(np.full(len(parts[-1]), self._gone[key][0]))
        return np.concatenate(parts), np.concatenate(versions)

    def _changes(self, key: int, version: int) -> tuple[NDArray[np.int32], NDArray[np.int64]]:
        region = self.regions[key]
        xyz = xyz_of(region, key)
        whole = self._whole(key) if region.changes[0] <= version else None
        if whole is None:
            return xyz, np.full(len(xyz), max(region.changes[0], version + 1))
        changed_at = unpack_rest(whole)["changed_at"]
        return xyz[changed_at > version], changed_at[changed_at > version]

    def _whole(self, key: int) -> ColdRegion | None:
        try:
            return replace(self.regions[key], data=self.shelves.get(self._numbers[key]))
        except OSError:
            self.lost_blocks += self.regions[key].count
            self.forget(key)
            return None

    def _drop(self, key: int) -> ColdRegion:
        region = self.regions.pop(key)
        self.shelves.drop(self._numbers.pop(key))
        self.blocks -= region.count
        self.memory_bytes -= region.memory_bytes
        return region
