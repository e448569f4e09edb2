"""What changes when a second map takes the place of the first, found in bounded steps."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from companion.mapping.rays import CELLS
from companion.mapping.sensor_model import UNKNOWN
from companion.mapping.voxel_map import VoxelMap


class Comparison:
    """Gives each block of `second` the version of its last change, as those who know `voxels` see it.

    Blocks of `second` must have versions that are larger than all of `voxels`: those that differ keep
    them. A block that has gone becomes one of unknown voxels, so that `changed_since` can name it.
    What is compressed counts as changed.

    >>> comparison = Comparison(voxels, second)
    >>> while comparison.advance(8192): voxels.insert(...)
    >>> comparison.finish()  # right before the second map takes the place of the first
    """

    def __init__(self, voxels: VoxelMap, second: VoxelMap) -> None:
        self._voxels, self._second = voxels, second
        self._begun = voxels.version
        self._had = voxels.changed_since(-1)
        self._next = self._row = 0  # of `_had`, of the second map
        self._done_at: int | None = None  # version of the second map

    def advance(self, blocks: int) -> bool:
        """Look at that many blocks; False: there are no more."""
        if self._next < len(self._had):
            self._add_gone(self._had[self._next : self._next + blocks])
            self._next += blocks
            return True
        count = self._second.blocks.count
        self._tell(np.arange(self._row, min(self._row + blocks, count)))
        self._row += blocks
        if self._row < count:
            return True
        self._done_at = self._second.version
        return False

    def finish(self) -> None:
        """Look again at what has changed in either map since the last step."""
        assert self._done_at is not None
        changed = self._voxels.changed_since(self._begun)
        self._add_gone(changed)
        blocks = self._second.blocks
        rows = np.flatnonzero(blocks.changed_at[: blocks.count] > self._done_at)
        others = blocks.rows_of(changed.astype(np.int64))
        blocks.changed_at[others[others >= 0]] = blocks.version  # unless it is the same, as the next line finds
        self._tell(np.union1d(rows, others[others >= 0]))

    def _add_gone(self, xyz: NDArray[np.int32]) -> None:
        """As unknown blocks, those at `xyz` (N, 3) that the second map does not have."""
        second, places = self._second, xyz[self._second.blocks.rows_of(xyz.astype(np.int64)) < 0]
        if second.memory.cold_regions and len(places):
            places = places[~any_known(second.memory.log_odds_of(places.astype(np.int64)))]
        second.blocks.add(places, np.full((len(places), CELLS), UNKNOWN, np.int8), second.steps.lowest, held=False)

    def _tell(self, rows: NDArray[np.int64]) -> None:
        """What is the same changed when it did in the first map."""
        old, new = self._voxels.blocks, self._second.blocks
        olds = old.rows_of(new.xyz[rows].astype(np.int64))
        same = np.empty(len(rows), np.bool_)
        _same_classes((rows, new.log_odds), (olds, old.log_odds), same)
        new.changed_at[rows[same]] = old.changed_at[olds[same]]


@njit(cache=True, nogil=True)
def any_known(values):  # type: ignore[no-untyped-def]
    """Whether (N,) any of the values (N, 512) is not UNKNOWN."""
    found = np.zeros(values.shape[0], np.bool_)
    for n in range(values.shape[0]):
        most = np.int8(UNKNOWN)
        for c in range(CELLS):
            most = max(most, values[n, c])
        found[n] = most != np.int8(UNKNOWN)
    return found


@njit(cache=True, nogil=True)
def _same_classes(news, olds, same):  # type: ignore[no-untyped-def]
    """Whether the block in each row of the one has the classes of that in the other; a row of -1 has no block."""
    (rows, new), (old_rows, old) = news, olds
    unknown, zero = np.int8(UNKNOWN), np.int8(0)
    for n in range(rows.size):
        differ = np.int8(0 if old_rows[n] >= 0 else -1)
        for c in range(CELLS if old_rows[n] >= 0 else 0):
            a, b = new[rows[n], c], old[old_rows[n], c]
            differ = np.int8(differ | np.int8(a ^ b))  # its sign bit: occupied <-> free or unknown
            differ = np.int8(differ | (unknown if (a == unknown) != (b == unknown) else zero))
        same[n] = differ >= zero
