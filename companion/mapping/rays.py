"""Which voxels one scan sees: rays rasterised without order into a sensor-centred bit grid.

A ray's voxels are the voxel of its start plus the one entered at each crossed x-, y- and
z-plane, the set of Amanatides and Woo, "A fast voxel traversal algorithm", 1987. Each of the
three families is affine in the number of the plane, so their indices come from branch-free
fixed-point loops. Indices are OR-ed into bits: a voxel seen by a thousand rays counts once.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from companion.core.messages import Array, Array32
from companion.mapping.lanes import LANES
from companion.mapping.ray_indices import families
from companion.mapping.ray_lines import HITS, LAST, TILE, cut_bits, ends, line_scratch, planes, slopes

u8, u32, u64 = np.uint8, np.uint32, np.uint64  # unsigned: no negative-index handling in kernels
BLOCK = 8  # voxels per block edge; 8^3 bits are one cache line
CELLS = BLOCK**3
WORDS = CELLS // 64
_STRIDES = (BLOCK * BLOCK, BLOCK, 1)  # of x, y, z inside a block
_INSIDE = 2  # blocks of slack around the farthest voxel
ScanBits = tuple[NDArray[np.uint64], NDArray[np.uint64], NDArray[np.int32]]
"""(free, hit, hit_of): block n of the scratch has the bits free[n] and hit[hit_of[n]], (8,) each."""
ToGrid = tuple[Array, Array, Array]
"""(R, offset, start): the ray to a vector v begins at `start` and ends at start + R v + offset, in voxels."""


class RayGrid:
    """Bits `free` (crossed by a ray) and `hit` (holds a return) of one scan, by scratch block.

    Scratch block (i, j, k) is map block `corner + (i, j, k)`; its number is (i * side + j) *
    side + k. Each hit bit has its free bit set, too. The consumer clears what it read, and then
    says so to `cleared`.
    """

    def __init__(self, resolution_m: float, range_m: float) -> None:
        self.resolution_m = resolution_m
        self.reach = math.ceil(range_m / resolution_m / BLOCK) + _INSIDE
        self.side = 2 * self.reach
        count = self.side**3
        self.free = np.zeros(count * WORDS, np.uint64)
        self._hit = np.zeros((1, WORDS), np.uint64)  # few blocks are hit: row 0 is that of all others
        self._hit_of = np.zeros(count, np.int32)
        self.hit_count = np.zeros(1, np.int64)  # rows in use
        self.corner = np.zeros(3, np.int64)
        self._reached = np.zeros((2, 3), np.int64)  # lowest and highest cell of any bit
        self._row = np.zeros(TILE * 3 * BLOCK * self.side + LANES, np.uint32)
        self._doubts = np.zeros(2 * TILE, np.int64)
        self._hit_rows = np.zeros(TILE, np.int64)
        self._lines = line_scratch()
        blocks = np.array([self.side**2, self.side, 1]) * CELLS
        strides = np.array(_STRIDES)
        self._strides = np.stack([strides, blocks - BLOCK * strides])  # index = x * [0] + (x >> 3) * [1]
        self._layout = self._strides, self.side, _along(self.side, self._strides)

    @property
    def bits(self) -> ScanBits:
        """What the scan left: (free, hit, hit_of)."""
        return self.free.reshape(-1, WORDS), self._hit, self._hit_of

    @property
    def hit_blocks(self) -> int:
        """How many blocks hold a return."""
        return int(self.hit_count[0])

    def cleared(self) -> None:
        """All bits, and `hit_of` of all blocks, are 0 again."""
        self.hit_count[0] = 0

    def place(self, origin_odom: Array) -> None:
        """Centre the empty grid on the block of the sensor position (3,), m."""
        block = np.floor(origin_odom / (self.resolution_m * BLOCK)).astype(np.int64)
        self.corner = block - self.reach
        self._reached[:] = np.floor(origin_odom / self.resolution_m).astype(np.int64) - BLOCK * self.corner

    def to_grid(self, R_odom_body: Array, offset_odom: Array, origin_odom: Array) -> ToGrid:
        """For rays from the origin (3,) to origin + offset + R v, m."""
        scale = 1.0 / self.resolution_m
        start = origin_odom * scale - BLOCK * self.corner
        return np.ascontiguousarray(R_odom_body * scale), offset_odom * scale, start

    def cast(self, vectors: Array32, to_grid: ToGrid, ranges: tuple[float, float, bool]) -> tuple[int, int]:
        """Rasterise rays from the sensor to `vectors` (N, 3) float32.

        `ranges` = (nearest length of v that counts, farthest ray, m, all rays miss). Rays beyond the
        farthest are cut there and hit nothing. Returns (rays used, voxel steps); rays that are not finite
        are not used.
        """
        near, far_m, miss = ranges
        if not len(vectors):
            return 0, 0
        if not miss:
            self.make_room(len(vectors))
        bits = (self.free.view(np.uint8), (self._hit, self._hit_of, self.hit_count), self._reached)
        used, steps = _cast(
            vectors.reshape(-1),
            to_grid,
            (near, far_m * (1.0 / self.resolution_m), miss),
            bits,
            (self._row, self._doubts, self._hit_rows),
            self._layout,
            self._lines,
        )
        return int(used), int(steps)

    def stretch(self, other: RayGrid) -> None:
        """Count the cells that `other` has reached as reached."""
        self._reached[0] = np.minimum(self._reached[0], other._reached[0])
        self._reached[1] = np.maximum(self._reached[1], other._reached[1])

    def mark_free(self, points_odom: Array) -> None:
        """Set the free bit of the voxels that hold the points (K, 3), m; outside: ignored."""
        points = points_odom[np.all(np.abs(points_odom) < 1e9, axis=1)]  # NaN fails, too
        cell = np.floor(points / self.resolution_m).astype(np.int64) - BLOCK * self.corner
        cell = cell[np.all((cell >= 0) & (cell < BLOCK * self.side), axis=1)]
        index = cell @ self._strides[0] + (cell >> 3) @ self._strides[1]
        np.bitwise_or.at(self.free, index >> 6, np.uint64(1) << (index & 63).astype(np.uint64))
        if len(cell):
            self._reached[0] = np.minimum(self._reached[0], cell.min(axis=0))
            self._reached[1] = np.maximum(self._reached[1], cell.max(axis=0))

    def make_room(self, returns: int) -> None:
        """Rows for as many blocks as that many returns can hit; memory is taken only for those used."""
        used, rows = self.hit_blocks + 1, self.hit_blocks + 1 + returns
        if rows > len(self._hit):
            more = np.zeros((2 * rows, WORDS), np.uint64)
            more[:used] = self._hit[:used]
            self._hit = more

    def met(self) -> NDArray[np.int64]:
        """Numbers of the scratch blocks with any bit, ascending."""
        around = self._reached + np.array([[-1], [1]])  # rounding at a border may cost one cell
        low, high = np.clip(around >> 3, 0, self.side - 1)
        found = np.empty(int(np.prod(high - low + 1)), np.int64)
        return found[: _met(self.free.reshape(-1, WORDS), self.side, low, high, found)]


def _along(side: int, strides: NDArray[np.int64]) -> NDArray[np.uint32]:
    """Shares of an index, (axis, upwards or downwards, cell): what is read from a place on comes in that order.

    LANES cells more on either side, which lanes behind the end of a ray may read.
    """
    cell = np.arange(-LANES, BLOCK * side + LANES)
    shares = (cell[:, None] * strides[0] + (cell[:, None] >> 3) * strides[1]).T.astype(np.uint32)
    return np.ascontiguousarray(np.stack([shares, shares[:, ::-1]], axis=1))


@njit(cache=True, nogil=True, error_model="numpy")
def _cast(vectors, pose, ranges, bits, scratch, layout, lines):  # type: ignore[no-untyped-def]
    """Tile by tile: the lines of its rays, then the indices of their voxels, then the bits."""
    free, hit, reached = bits
    R, offset, origin = pose
    start, whole, (row, doubts, hit_rows) = (origin[0], origin[1], origin[2]), lines[3], scratch
    turn = (R[0, 0], R[0, 1], R[0, 2], R[1, 0], R[1, 1], R[1, 2], R[2, 0], R[2, 1], R[2, 2])
    flat_pose = (turn, (offset[0], offset[1], offset[2]), start)
    used = steps = 0
    for first in range(0, vectors.size // 3, TILE):
        count = min(TILE, vectors.size // 3 - first)
        used += ends(vectors, (first, count), flat_pose, ranges, lines)
        planes(count, start, lines, layout[2].shape[2])
        for axis in range(3):
            slopes(count, start, lines, axis)
        cut_bits(lines)
        _reach(reached, whole, count)
        end = families((row, doubts), count, lines, layout)
        steps += _set_bits(free, row[:end])
        _set_ends(free, hit, _ends(row, count, whole, layout[2]), hit_rows)
    if used > 0:
        _set_bit(free, u64(_index(int(start[0]), int(start[1]), int(start[2]), layout[2])))
    return used, steps


@njit(cache=True, nogil=True)
def _reach(reached, whole, count):  # type: ignore[no-untyped-def]
    for k in range(3):
        low, high = reached[0, k], reached[1, k]
        for n in range(LAST + k * TILE, LAST + k * TILE + count):
            low, high = min(low, whole[n]), max(high, whole[n])
        reached[0, k], reached[1, k] = low, high


@njit(cache=True, nogil=True)
def _ends(row, count, whole, along):  # type: ignore[no-untyped-def]
    """Indices of the voxels that hold a return, a view of `row`."""
    found = 0
    for n in range(count):
        row[found] = _index(whole[LAST + n], whole[LAST + TILE + n], whole[LAST + 2 * TILE + n], along)
        found += whole[HITS + n]
    return row[:found]


@njit(cache=True, nogil=True)
def _index(x, y, z, along):  # type: ignore[no-untyped-def]
    return along[0, 0, u64(x + LANES)] + along[1, 0, u64(y + LANES)] + along[2, 0, u64(z + LANES)]


@njit(cache=True, nogil=True)
def _set_bit(bits, index):  # type: ignore[no-untyped-def]
    byte = index >> u64(3)
    bits[byte] = u8(bits[byte] | u8(u64(1) << (index & u64(7))))


@njit(cache=True, nogil=True)
def _set_ends(free, hit, ends_at, rows):  # type: ignore[no-untyped-def]
    """Set both bits of the voxels that hold a return.

    The rows of all are looked up first: an address that waits for a look-up, behind a store that may be to
    the same place, cost 43 ns per return instead of 2.
    """
    words, row_of, count = hit
    octets = words.reshape(-1).view(np.uint8)
    for n in range(ends_at.size):
        block = ends_at[n] >> u32(9)
        if row_of[block] == 0:
            count[0] += 1
            row_of[block] = count[0]
        rows[n] = row_of[block]
    for n in range(ends_at.size):
        index = u64(ends_at[n])
        _set_bit(octets, (u64(rows[n]) << u64(9)) | (index & u64(CELLS - 1)))
        _set_bit(free, index)


@njit(cache=True, nogil=True)
def _set_bits(bits, row):  # type: ignore[no-untyped-def]
    for k in range(row.size):
        _set_bit(bits, u64(row[k]))
    return row.size


@njit(cache=True, nogil=True)
def _met(free, side, low, high, found):  # type: ignore[no-untyped-def]
    count = 0
    for i in range(low[0], high[0] + 1):
        for j in range(low[1], high[1] + 1):
            for number in range((i * side + j) * side + low[2], (i * side + j) * side + high[2] + 1):
                words = free[u64(number)]
                found[count] = number
                any_bit = words[0] | words[1] | words[2] | words[3] | words[4] | words[5] | words[6] | words[7]
                count += any_bit != u64(0)
    return count
