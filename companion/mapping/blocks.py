"""The one store of the map: an unbounded hash of 8^3 blocks of int8 log-odds."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from companion.mapping.rays import BLOCK, CELLS, WORDS, RayGrid
from companion.mapping.sensor_model import UNKNOWN, Steps

i16, i64, u8, u64 = np.int16, np.int64, np.uint8, np.uint64
_GROWTH = 4096  # blocks: 2 MB at a time, so that growing never stalls a scan
_EMPTY = -1


class BlockStore:
    """Blocks by position. Block (i, j, k) holds cells 8 * (i, j, k) up to + 7, z fastest.

    `xyz` (capacity, 3) int32 and `log_odds` (capacity, 512) int8 grow in place: views of
    them must not outlive a call. The first `count` rows are in use, in order of creation.
    """

    def __init__(self) -> None:
        self.count = 0
        self.xyz = np.zeros((_GROWTH, 3), np.int32)
        self.log_odds = np.zeros((_GROWTH, CELLS), np.int8)
        self._settled = np.zeros((_GROWTH, WORDS), np.uint64)  # bits: the cell is at the lower clamp
        self._keys = np.full(4 * _GROWTH, _EMPTY, np.int64)
        self._rows = np.zeros(4 * _GROWTH, np.int32)

    @property
    def memory_bytes(self) -> int:
        """Bytes held, spare capacity included."""
        arrays = (self.xyz, self.log_odds, self._settled, self._keys, self._rows)
        return sum(a.nbytes for a in arrays)

    def fold(self, grid: RayGrid, steps: Steps) -> tuple[int, NDArray[np.int32]]:
        """Add one scan's bits to the log-odds, and clear the bits.

        Returns the number of blocks met and the positions (K, 3) of those in which a cell
        changed between unknown, free and occupied.
        """
        met = grid.met()
        self._reserve(self.count + len(met))
        rows, before = np.empty(len(met), np.int64), self.count
        table = (self._keys, self._rows, self.xyz)
        self.count = int(_rows_of(met, grid.side, grid.corner, table, self.count, rows))
        self.log_odds[before : self.count] = UNKNOWN
        self._settled[before : self.count] = 0
        amounts = np.array([steps.hit, steps.miss, steps.lowest, steps.highest], np.int16)
        changed = np.zeros(len(met), np.uint8)
        words = (grid.free.reshape(-1, WORDS), grid.hit.reshape(-1, WORDS))
        _fold(met, rows, words, (self.log_odds, self._settled), amounts, changed)
        return len(met), self.xyz[rows[changed != 0]]

    def at(self, cells: NDArray[np.int64]) -> NDArray[np.int8]:
        """Log-odds steps (N,) of cells (N, 3); UNKNOWN where no ray has been."""
        found = np.empty(len(cells), np.int8)
        _at(cells, (self._keys, self._rows), self.log_odds, found)
        return found

    def window(self, corner: NDArray[np.int64], states: NDArray[np.uint8]) -> None:
        """Fill `states` (8a, 8b, 8c): 0 unknown, 1 free, 2 occupied; block `corner` first."""
        _window(corner, (self._keys, self._rows), self.log_odds, states.view(np.uint64))

    def load(self, xyz: NDArray[np.int32], log_odds: NDArray[np.int8], lowest: int) -> None:
        """Replace everything by copies of blocks at `xyz` (N, 3), each of 512 `log_odds`."""
        self.__init__()  # type: ignore[misc]
        self._reserve(len(xyz))
        self.xyz[: len(xyz)], self.log_odds[: len(xyz)] = xyz, log_odds
        settled = np.packbits(log_odds == lowest, axis=1, bitorder="little")
        self._settled[: len(xyz)] = settled.view(np.uint64)
        self.count = len(xyz)
        _enter(self.xyz, self.count, self._keys, self._rows)

    def _reserve(self, count: int) -> None:
        """Make room for `count` blocks; the hash stays at most half full."""
        capacity = len(self.xyz)
        if count > capacity:
            capacity = -(-count // _GROWTH) * _GROWTH
            self.xyz.resize((capacity, 3), refcheck=False)  # realloc: large arrays move without a copy
            self.log_odds.resize((capacity, CELLS), refcheck=False)
            self._settled.resize((capacity, WORDS), refcheck=False)
        if 2 * count > len(self._keys):
            size = 1 << (2 * count - 1).bit_length()
            self._keys, self._rows = np.full(size, _EMPTY, np.int64), np.zeros(size, np.int32)
            _enter(self.xyz, self.count, self._keys, self._rows)


@njit(cache=True, nogil=True)
def _rows_of(met, side, corner, table, count, rows):  # type: ignore[no-untyped-def]
    """Find or make the block of each scratch block; returns the new number of blocks."""
    keys, values, xyz = table
    for m in range(met.size):
        i, rest = divmod(met[m], side * side)
        j, k = divmod(rest, side)
        x, y, z = i + corner[0], j + corner[1], k + corner[2]
        slot = _slot(keys, x, y, z)
        if keys[slot] == _EMPTY:
            keys[slot] = _key(x, y, z)
            values[slot] = count
            xyz[count, 0], xyz[count, 1], xyz[count, 2] = x, y, z
            count += 1
        rows[m] = values[slot]
    return count


@njit(cache=True, nogil=True)
def _enter(xyz, count, keys, values):  # type: ignore[no-untyped-def]
    for row in range(count):
        x, y, z = i64(xyz[row, 0]), i64(xyz[row, 1]), i64(xyz[row, 2])
        slot = _slot(keys, x, y, z)
        keys[slot] = _key(x, y, z)
        values[slot] = row


@njit(cache=True, nogil=True)
def _fold(met, rows, words, blocks, amounts, changed):  # type: ignore[no-untyped-def]
    """One miss for each free bit without a hit bit, one hit for each hit bit; clears both.

    A miss cannot change a settled cell, so most blocks of a place seen before are skipped.
    """
    free, hit = words
    log_odds, settled = blocks
    octets = np.empty((2, CELLS // 8), np.uint64)  # of cells that get a miss, a hit
    for m in range(met.size):
        f, h, row = free[met[m]], hit[met[m]], rows[m]
        done = settled[row]
        any_bit = u64(0)
        for w in range(WORDS):
            f[w] &= ~(h[w] | done[w])
            any_bit |= f[w] | h[w]
        if any_bit != u64(0):
            _spread(f.view(np.uint8), octets[0])
            _spread(h.view(np.uint8), octets[1])
            cells = log_odds[row]
            changed[m] = _update(cells, octets[0].view(np.uint8), octets[1].view(np.uint8), amounts)
            _settle(cells.view(np.uint64), u8(amounts[2]), done.view(np.uint8))
        f[:] = u64(0)
        h[:] = u64(0)


@njit(cache=True, nogil=True)
def _spread(bits, octets):  # type: ignore[no-untyped-def]
    """Bit i of the bytes makes byte i of the octets not zero."""
    for n in range(CELLS // 8):
        octets[n] = (u64(bits[n]) * u64(0x0101010101010101)) & u64(0x8040201008040201)


@njit(cache=True, nogil=True)
def _update(cells, missed, hit, amounts):  # type: ignore[no-untyped-def]
    """Branch-free over the block; returns whether a cell changed its class."""
    unknown, zero = np.int8(UNKNOWN), np.int8(0)
    hit_step, miss_step, lowest, highest = amounts[0], amounts[1], amounts[2], amounts[3]
    differ = zero
    for c in range(CELLS):
        old = cells[c]
        level = i16(0) if old == unknown else i16(old)
        level = i16(level + (hit_step if hit[c] != u8(0) else miss_step))
        level = lowest if level < lowest else level
        level = highest if level > highest else level
        new = np.int8(level) if (missed[c] | hit[c]) != u8(0) else old
        cells[c] = new
        differ = np.int8(differ | np.int8(old ^ new))  # its sign bit: occupied <-> free or unknown
        differ = np.int8(differ | (unknown if (old == unknown and new != unknown) else zero))
    return u8(differ < zero)


@njit(cache=True, nogil=True)
def _settle(octets, lowest, bits):  # type: ignore[no-untyped-def]
    """Set the bits of the cells that equal `lowest`; eight cells are one octet and one byte of bits."""
    low, top, gather = u64(0x7F7F7F7F7F7F7F7F), u64(0x0101010101010101), u64(0x0102040810204080)
    pattern = u64(lowest) * top
    for n in range(CELLS // 8):
        x = octets[n] ^ pattern
        zero_bytes = (~(((x & low) + low) | x | low)) >> u64(7)  # 1 in each byte that is zero
        bits[n] = u8((zero_bytes * gather) >> u64(56))


@njit(cache=True, nogil=True)
def _at(cells, table, log_odds, found):  # type: ignore[no-untyped-def]
    keys, values = table
    for n in range(cells.shape[0]):
        x, y, z = cells[n, 0], cells[n, 1], cells[n, 2]
        slot = _slot(keys, x >> 3, y >> 3, z >> 3)
        inside = (x & 7) * BLOCK * BLOCK + (y & 7) * BLOCK + (z & 7)
        found[n] = UNKNOWN if keys[slot] == _EMPTY else log_odds[values[slot], inside]


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
                slot = _slot(keys, corner[0] + i, corner[1] + j, corner[2] + k)
                known = keys[slot] != _EMPTY
                if known:
                    cells = log_odds[values[slot]]
                    for c in range(CELLS):
                        state = u8(2) if cells[c] >= zero else u8(1)
                        block[c] = u8(0) if cells[c] == unknown else state
                for line in range(BLOCK * BLOCK):
                    lines[BLOCK * i + (line >> 3), BLOCK * j + (line & 7), k] = words[line] if known else u64(0)


@njit(cache=True, nogil=True)
def _slot(keys, x, y, z):  # type: ignore[no-untyped-def]
    """Where block (x, y, z) is or would go. 2x2x4 neighbours share 16 slots in a row (locality)."""
    key = _key(x, y, z)
    mask = i64(keys.size - 1)
    h = u64(x >> 1) * u64(0x9E3779B97F4A7C15)
    h ^= u64(y >> 1) * u64(0xC2B2AE3D27D4EB4F) ^ u64(z >> 2) * u64(0x165667B19E3779F9)
    h ^= h >> u64(29)
    slot = (i64((h >> u64(20)) << u64(4)) | ((x & 1) << 3) | ((y & 1) << 2) | (z & 3)) & mask
    while keys[slot] != key and keys[slot] != _EMPTY:
        slot = (slot + 1) & mask
    return slot


@njit(cache=True, nogil=True)
def _key(x, y, z):  # type: ignore[no-untyped-def]
    """21 bits per axis: 1,600 km of 0.2 m cells either way."""
    return ((x & 0x1FFFFF) << 42) | ((y & 0x1FFFFF) << 21) | (z & 0x1FFFFF)
