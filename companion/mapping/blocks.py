"""The one store of the map: an unbounded hash of 8^3 blocks of int8 log-odds."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from companion.mapping.block_hash import EMPTY, enter, find, find_scratch, leave, make_scratch, slot_of
from companion.mapping.fold import fold_bits
from companion.mapping.marks import MISSES_COUNT_EVERY, MarkTable
from companion.mapping.rays import BLOCK, CELLS, WORDS, RayGrid, ScanBits
from companion.mapping.sensor_model import UNKNOWN, Steps

u8, u64 = np.uint8, np.uint64
Watch = Callable[[NDArray[np.int64], NDArray[np.int64], ScanBits], None]
"""Sees a scan right before it changes the store: numbers (K,) of the scratch blocks it met, rows (K,)
of the store, and the scan's bits."""
_GROWTH = 4096  # blocks: 2 MB at a time, so that growing never stalls a scan
_TAKEN = ("xyz", "log_odds", "changed_at", "seen_ns", "held", "stirred")  # by `take`, as they are
_PER_ROW = (*_TAKEN, "_slots", "_settled")


class BlockStore:
    """Blocks by position. Block (i, j, k) holds cells 8 * (i, j, k) up to + 7, z fastest.

    The arrays of `_PER_ROW` hold one row per block and grow in place: views of them must not
    outlive a call. The first `count` rows are in use; without `remove`, in order of creation.
    `version` counts the changes of the store. `marking`: folding keeps the marks that decay reads.
    """

    def __init__(self, *, marking: bool = False) -> None:
        self.marking = marking
        self.count = self.version = 0
        self._folded = 0  # scans
        self.xyz = np.zeros((_GROWTH, 3), np.int32)
        self.log_odds = np.zeros((_GROWTH, CELLS), np.int8)
        self.changed_at = np.zeros(_GROWTH, np.int64)  # version in which a cell last changed its class
        self.seen_ns = np.zeros(_GROWTH, np.int64)  # stamp of the newest scan with a ray in the block
        self.held = np.zeros(_GROWTH, np.uint8)  # 1: of a loaded map, which no decay may erase
        self.stirred = np.zeros(_GROWTH, np.uint8)  # passes of decay that have to look at the block
        self._slots = np.zeros(_GROWTH, np.int32)  # in the table of marks; 0: the block has none
        self._marks = MarkTable()
        self._settled = np.zeros((_GROWTH, WORDS), np.uint64)  # bits: the cell is at the lower clamp
        self._keys = np.full(4 * _GROWTH, EMPTY, np.int64)
        self._rows = np.zeros(4 * _GROWTH, np.int32)

    @property
    def table(self) -> tuple[NDArray[np.int64], NDArray[np.int32]]:
        """The hash as kernels want it, (keys, rows): `slot_of` finds a block in it."""
        return self._keys, self._rows

    @property
    def memory_bytes(self) -> int:
        """Bytes held, spare capacity included."""
        arrays = [getattr(self, name) for name in _PER_ROW]
        return sum(int(a.nbytes) for a in (*arrays, self._keys, self._rows)) + self._marks.memory_bytes

    @property
    def marks(self) -> tuple[Any, ...]:
        """As the kernels of decay want them: (whether they are kept, slots, stirred, table)."""
        return self.marking, self._slots, self.stirred, self._marks.arrays

    def fold(
        self, grid: RayGrid, steps: Steps, stamp_ns: int, watch: Watch | None = None
    ) -> tuple[int, NDArray[np.int32]]:
        """Add one scan's bits to the log-odds, and clear the bits; `watch` sees them right before.

        Returns the number of blocks met and the positions (K, 3) of those in which a cell
        changed between unknown, free and occupied.
        """
        met = grid.met()
        rows = self._make(met, grid)
        spares = self._folded % MISSES_COUNT_EVERY != 0
        amounts = np.array([steps.hit, steps.miss, steps.lowest, steps.highest, spares], np.int16)
        changed = np.zeros(len(met), np.uint8)
        if watch is not None:
            watch(met, rows, grid.bits)
        if self.marking:
            self._marks.reserve(grid.hit_blocks)
        fold_bits(met, rows, grid.bits, ((self.log_odds, self._settled), self.marks), amounts, changed)
        grid.cleared()
        self._folded += 1
        self.seen_ns[rows] = stamp_ns
        return len(met), self.xyz[self.mark_changed(rows[changed != 0])]

    def _make(self, met: NDArray[np.int64], grid: RayGrid) -> NDArray[np.int64]:
        """Row (K,) of each scratch block; those that are not there are made."""
        rows, place, first = np.empty(len(met), np.int64), (grid.side, grid.corner), self.count
        missing = int(find_scratch(met, place, self.table, rows))
        if missing:
            self._reserve(first + missing)
            make_scratch(met, place, (self._keys, self._rows, self.xyz), first, rows)
            self._blank(first, first + missing)
            self.count = first + missing
        return rows

    def mark_changed(self, rows: NDArray[np.int64]) -> NDArray[np.int64]:
        """A new version, in which cells of the blocks in `rows` (K,) changed their class; returns `rows`."""
        self.version += 1
        self.changed_at[rows] = self.version
        return rows

    def rows_of(self, xyz: NDArray[np.int64]) -> NDArray[np.int64]:
        """Row (N,) of each block at `xyz` (N, 3); -1: there is none."""
        rows = np.empty(len(xyz), np.int64)
        find(np.asarray(xyz, np.int64), (self._keys, self._rows), rows)
        return rows

    def at(self, cells: NDArray[np.int64]) -> NDArray[np.int8]:
        """Log-odds steps (N,) of cells (N, 3); UNKNOWN where no ray has been."""
        found = np.empty(len(cells), np.int8)
        _at(cells, (self._keys, self._rows), self.log_odds, found)
        return found

    def window(self, corner: NDArray[np.int64], states: NDArray[np.uint8]) -> None:
        """Fill `states` (8a, 8b, 8c): 0 unknown, 1 free, 2 occupied; block `corner` first."""
        _window(corner, (self._keys, self._rows), self.log_odds, states.view(np.uint64))

    def add(self, xyz: NDArray[np.int32], log_odds: NDArray[np.int8], lowest: int, held: bool) -> None:
        """Take in copies of blocks at `xyz` (N, 3), none of them there yet, each of 512 `log_odds`."""
        first, last = self.count, self.count + len(xyz)
        self._reserve(last)
        self._blank(first, last)
        self.xyz[first:last], self.held[first:last] = xyz, held
        self.count = last
        rows = np.arange(first, last)
        enter(self.xyz, rows, self._keys, self._rows)
        self.write(rows, log_odds, lowest)

    def take(self, rows: NDArray[np.int64]) -> dict[str, NDArray[Any]]:
        """Copies of everything that the blocks in `rows` (K,) hold, by the name of its array."""
        taken = {name: getattr(self, name)[rows] for name in _TAKEN}
        return taken | {"marks": self._marks.bits[self._slots[rows]]}

    def put(self, blocks: Mapping[str, NDArray[Any]], lowest: int) -> None:
        """Take in blocks as `take` gave them, none of them there; nothing of them has changed."""
        first, last = self.count, self.count + len(blocks["xyz"])
        self._reserve(last)
        for name in _TAKEN:
            getattr(self, name)[first:last] = blocks[name]
        self._settled[first:last] = _settled(blocks["log_odds"], lowest)
        self._slots[first:last] = self._marks.store(blocks["marks"])
        self.count = last
        enter(self.xyz, np.arange(first, last), self._keys, self._rows)

    def write(self, rows: NDArray[np.int64], log_odds: NDArray[np.int8], lowest: int) -> None:
        """Give the blocks in `rows` (K,) other `log_odds` (K, 512); `lowest` is the lower clamp."""
        self.log_odds[rows] = log_odds
        self._settled[rows] = _settled(log_odds, lowest)
        self.mark_changed(rows)

    def remove(self, rows: NDArray[np.int64]) -> None:
        """Forget the blocks in `rows` (K,), each named once; the last rows move into the gaps."""
        kept = self.count - len(rows)
        gaps = rows[rows < kept]
        movers = np.setdiff1d(np.arange(kept, self.count), rows, assume_unique=True)
        leave(self.xyz, rows, self._keys, self._rows)
        self._marks.release(self._slots[rows])
        for name in _PER_ROW:
            array = getattr(self, name)
            array[gaps] = array[movers]
        enter(self.xyz, gaps, self._keys, self._rows)
        self.count = kept
        if len(self.xyz) > kept + 2 * _GROWTH:
            self._resize(kept + _GROWTH)

    def let_go(self, blocks: int) -> bool:
        """Drop so many blocks of a store that is not used any more; False: there were none."""
        there = self.count > 0
        self.count = max(self.count - blocks, 0)
        self._resize(max(self.count, 1))
        return there

    def _blank(self, first: int, last: int) -> None:
        """Make rows those of unknown blocks; `xyz` is the caller's matter."""
        self.log_odds[first:last] = UNKNOWN
        for array in (self._settled, self.changed_at, self.seen_ns, self.held, self.stirred, self._slots):
            array[first:last] = 0

    def _reserve(self, count: int) -> None:
        """Make room for `count` blocks; the hash stays at most half full."""
        if count > len(self.xyz):
            self._resize(count)
        if 2 * count > len(self._keys):
            size = 1 << (2 * count - 1).bit_length()
            self._keys, self._rows = np.full(size, EMPTY, np.int64), np.zeros(size, np.int32)
            enter(self.xyz, np.arange(self.count), self._keys, self._rows)

    def _resize(self, count: int) -> None:
        """Rows for `count` blocks, in whole slabs."""
        capacity = -(-count // _GROWTH) * _GROWTH
        for name in _PER_ROW:
            array = getattr(self, name)
            array.resize((capacity, *array.shape[1:]), refcheck=False)  # realloc: large arrays move without a copy


def _settled(log_odds: NDArray[np.int8], lowest: int) -> NDArray[np.uint64]:
    return np.packbits(log_odds == lowest, axis=1, bitorder="little").view(np.uint64)


@njit(cache=True, nogil=True)
def _at(cells, table, log_odds, found):  # type: ignore[no-untyped-def]
    keys, values = table
    for n in range(cells.shape[0]):
        x, y, z = cells[n, 0], cells[n, 1], cells[n, 2]
        slot = slot_of(keys, x >> 3, y >> 3, z >> 3)
        inside = (x & 7) * BLOCK * BLOCK + (y & 7) * BLOCK + (z & 7)
        found[n] = UNKNOWN if keys[slot] == EMPTY else log_odds[values[slot], inside]


@njit(cache=True, nogil=True)
def _window(corner, table, log_odds, lines):  # type: ignore[no-untyped-def]
    """`lines` are the states along z, eight to a word."""
    keys, values = table
    block = np.empty(CELLS, np.uint8)
    words = block.view(np.uint64)
    unknown, zero = np.int8(UNKNOWN), np.int8(0)
    for i in range(lines.shape[0] // BLOCK):
        for j in range(lines.shape[1] // BLOCK):
            for k in range(lines.shape[2]):
                slot = slot_of(keys, corner[0] + i, corner[1] + j, corner[2] + k)
                known = keys[slot] != EMPTY
                if known:
                    cells = log_odds[values[slot]]
                    for c in range(CELLS):
                        state = u8(2) if cells[c] >= zero else u8(1)
                        block[c] = u8(0) if cells[c] == unknown else state
                for line in range(BLOCK * BLOCK):
                    lines[BLOCK * i + (line >> 3), BLOCK * j + (line & 7), k] = words[line] if known else u64(0)
