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

u8, u32, u64 = np.uint8, np.uint32, np.uint64  # unsigned: no negative-index handling in kernels
BLOCK = 8  # voxels per block edge; 8^3 bits are one cache line
CELLS = BLOCK**3
WORDS = CELLS // 64
_FRACTION = 44  # bits after the point: an error of 2e-11 voxels after 300 planes
_ONE = float(1 << _FRACTION)
_STRIDES = (BLOCK * BLOCK, BLOCK, 1)  # of x, y, z inside a block
_INSIDE = 2  # blocks of slack around the farthest voxel
_BATCH = 8192  # voxel indices collected before their bits are set
_CHUNK = 32  # a family is written in whole chunks
_STEEPEST = 1024.0  # slope bound; a steeper family has a single voxel, whose slope does not matter


class RayGrid:
    """Bits `free` (crossed by a ray) and `hit` (holds a return) of one scan, by scratch block.

    Scratch block (i, j, k) is map block `corner + (i, j, k)`; its number is (i * side + j) *
    side + k. Each hit bit has its free bit set, too. The consumer clears what it read.
    """

    def __init__(self, resolution_m: float, range_m: float) -> None:
        self.resolution_m = resolution_m
        self.reach = math.ceil(range_m / resolution_m / BLOCK) + _INSIDE
        self.side = 2 * self.reach
        count = self.side**3
        self.free = np.zeros(count * WORDS, np.uint64)
        self.hit = np.zeros(count * WORDS, np.uint64)
        self.corner = np.zeros(3, np.int64)
        self._reached = np.zeros((2, 3), np.int64)  # lowest and highest cell of any bit
        self._row = np.zeros(_BATCH + 3 * BLOCK * self.side + _CHUNK, np.uint32)
        blocks = np.array([self.side**2, self.side, 1]) * CELLS
        strides = np.array(_STRIDES)
        self._strides = np.stack([strides, blocks - BLOCK * strides])  # index = x * [0] + (x >> 3) * [1]

    def place(self, origin_odom: Array) -> None:
        """Centre the empty grid on the block of the sensor position (3,), m."""
        block = np.floor(origin_odom / (self.resolution_m * BLOCK)).astype(np.int64)
        self.corner = block - self.reach
        self._reached[:] = np.floor(origin_odom / self.resolution_m).astype(np.int64) - BLOCK * self.corner

    def cast(
        self, vectors: Array32, to_odom: tuple[Array, Array, Array], ranges: tuple[float, float, bool]
    ) -> tuple[int, int]:
        """Rasterise rays from the sensor.

        `vectors` (N, 3) float32 in body; `to_odom` = (R_odom_body, offset, origin) so that
        the ray is R v + offset, from origin, m; `ranges` = (nearest length of v that counts,
        farthest ray, all rays miss), m. Rays beyond the farthest are cut there and hit
        nothing. Returns (rays used, voxel steps); rays that are not finite are not used.
        """
        R, offset, origin = to_odom
        near_m, far_m, miss = ranges
        scale = 1.0 / self.resolution_m
        start = origin * scale - BLOCK * self.corner
        bits = (self.free.view(np.uint8), self.hit.view(np.uint8), self._reached)
        pose = (np.ascontiguousarray(R * scale), offset * scale, start)
        used, steps = _cast(vectors, pose, (near_m, far_m * scale, miss), bits, self._row, self._strides)
        return int(used), int(steps)

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

    def met(self) -> NDArray[np.int64]:
        """Numbers of the scratch blocks with any bit, ascending."""
        around = self._reached + np.array([[-1], [1]])  # rounding at a border may cost one cell
        low, high = np.clip(around >> 3, 0, self.side - 1)
        found = np.empty(int(np.prod(high - low + 1)), np.int64)
        return found[: _met(self.free.reshape(-1, WORDS), self.side, low, high, found)]


@njit(cache=True, nogil=True, error_model="numpy")
def _cast(vectors, pose, ranges, bits, row, strides):  # type: ignore[no-untyped-def]
    """One pass over the rays; all lengths in voxels, except `near` in the unit of `vectors`."""
    start = pose[2]
    free, hit, reached = bits
    cell = (int(start[0]), int(start[1]), int(start[2]))
    used = steps = end = 0
    for i in range(vectors.shape[0]):
        counts, cut, d = _ray(vectors[i], pose, ranges)
        if not counts:
            continue
        used += 1
        last = (int(start[0] + d[0]), int(start[1] + d[1]), int(start[2] + d[2]))
        _reach(reached, last)
        if not cut:
            index = _index(last[0], last[1], last[2], strides)
            _set_bit(hit, index)
            _set_bit(free, index)
        end = _crossed(row, end, ((start[0], start[1], start[2]), cell, last, d, cut), strides)
        if end > _BATCH:
            steps += _set_bits(free, row[:end])
            end = 0
    steps += _set_bits(free, row[:end])
    if used > 0:
        _reach(reached, cell)
        _set_bit(free, _index(cell[0], cell[1], cell[2], strides))
    return used, steps


@njit(cache=True, nogil=True, error_model="numpy")
def _ray(vector, pose, ranges):  # type: ignore[no-untyped-def]
    """Whether a ray counts, whether it ends without a hit, and its way in voxels, at most `far` long."""
    R, offset, _ = pose
    near, far, miss = ranges
    a, b, c = np.float64(vector[0]), np.float64(vector[1]), np.float64(vector[2])
    dx = R[0, 0] * a + R[0, 1] * b + R[0, 2] * c + offset[0]
    dy = R[1, 0] * a + R[1, 1] * b + R[1, 2] * c + offset[1]
    dz = R[2, 0] * a + R[2, 1] * b + R[2, 2] * c + offset[2]
    length2 = dx * dx + dy * dy + dz * dz
    counts = 0.0 < length2 < 1e18 and a * a + b * b + c * c >= near * near  # NaN fails, too
    cut = miss or length2 > far * far
    shrink = far / math.sqrt(length2) if cut else 1.0
    return counts, cut, (dx * shrink, dy * shrink, dz * shrink)


@njit(cache=True, nogil=True)
def _reach(reached, cell):  # type: ignore[no-untyped-def]
    for k in range(3):
        reached[0, k] = min(reached[0, k], cell[k])
        reached[1, k] = max(reached[1, k], cell[k])


@njit(cache=True, nogil=True, error_model="numpy")
def _crossed(row, end, ray, strides):  # type: ignore[no-untyped-def]
    """Write the voxels that a ray enters behind the first `end` indices; returns the new end."""
    (ox, oy, oz), (ix, iy, iz), (jx, jy, jz), (dx, dy, dz), cut = ray
    x_stride = (u32(strides[0, 0]), u32(strides[1, 0]))
    y_stride = (u32(strides[0, 1]), u32(strides[1, 1]))
    z_stride = (u32(strides[0, 2]), u32(strides[1, 2]))
    nx, ny, nz = abs(jx - ix), abs(jy - iy), abs(jz - iz)  # planes crossed
    (sx, tx, gx), (sy, ty, gy), (sz, tz, gz) = _planes(ox, ix, dx), _planes(oy, iy, dy), _planes(oz, iz, dz)
    if cut and nx + ny + nz > 0:  # OctoMap's choice: the voxel of the cut is not seen
        nx, ny, nz = _without_last((nx, ny, nz), (tx, ty, tz), (gx, gy, gz))
    _family(row, end, (nx, ix + sx, sx, x_stride), (tx, gx), (oy, dy, y_stride), (oz, dz, z_stride))
    end += nx
    _family(row, end, (ny, iy + sy, sy, y_stride), (ty, gy), (ox, dx, x_stride), (oz, dz, z_stride))
    end += ny
    _family(row, end, (nz, iz + sz, sz, z_stride), (tz, gz), (ox, dx, x_stride), (oy, dy, y_stride))
    return end + nz


@njit(cache=True, nogil=True, error_model="numpy")
def _planes(o, i, d):  # type: ignore[no-untyped-def]
    """Of one axis: direction, share of the ray to its first plane, share from plane to plane."""
    gap = 1.0 / abs(d)
    return (1, (i + 1 - o) * gap, gap) if d > 0 else (-1, (o - i) * gap, gap)


@njit(cache=True, nogil=True, error_model="numpy")
def _without_last(counts, first, gaps):  # type: ignore[no-untyped-def]
    """Planes per axis less the one that is crossed last."""
    nx, ny, nz = counts
    last_x = first[0] + (nx - 1) * gaps[0] if nx > 0 else -1.0
    last_y = first[1] + (ny - 1) * gaps[1] if ny > 0 else -1.0
    last_z = first[2] + (nz - 1) * gaps[2] if nz > 0 else -1.0
    if last_x >= last_y and last_x >= last_z:
        return nx - 1, ny, nz
    if last_y >= last_z:
        return nx, ny - 1, nz
    return nx, ny, nz - 1


@njit(cache=True, nogil=True, error_model="numpy")
def _family(row, end, planes, times, axis_u, axis_v):  # type: ignore[no-untyped-def]
    """Indices of the voxels entered at `count` planes of one axis; u and v are the other two.

    Writes whole chunks, so garbage may follow the `count` indices.
    """
    count, w0, step, (sw, bw) = planes
    t0, dt = times
    u0, du, (su, bu) = axis_u
    v0, dv, (sv, bv) = axis_v
    u, v, w = _fixed(u0 + du * t0), _fixed(v0 + dv * t0), u32(w0)
    u_step = _fixed(min(max(du * dt, -_STEEPEST), _STEEPEST))
    v_step = _fixed(min(max(dv * dt, -_STEEPEST), _STEEPEST))
    w_step = u32(step)
    for first in range(0, count, _CHUNK):
        chunk = row[end + first : end + first + _CHUNK]
        for j in range(_CHUNK):
            k = u64(first + j)
            iu = u32((u + k * u_step) >> u64(_FRACTION))
            iv = u32((v + k * v_step) >> u64(_FRACTION))
            iw = u32(w + u32(u32(k) * w_step))
            along_u = u32(u32(iu * su) + u32(u32(iu >> u32(3)) * bu))
            along_v = u32(u32(iv * sv) + u32(u32(iv >> u32(3)) * bv))
            along_w = u32(u32(iw * sw) + u32(u32(iw >> u32(3)) * bw))
            chunk[j] = u32(u32(along_u + along_v) + along_w)


@njit(cache=True, nogil=True)
def _fixed(x):  # type: ignore[no-untyped-def]
    return u64(np.int64(x * _ONE))


@njit(cache=True, nogil=True)
def _index(x, y, z, strides):  # type: ignore[no-untyped-def]
    inside = x * strides[0, 0] + y * strides[0, 1] + z * strides[0, 2]
    return u64(inside + (x >> 3) * strides[1, 0] + (y >> 3) * strides[1, 1] + (z >> 3) * strides[1, 2])


@njit(cache=True, nogil=True)
def _set_bit(bits, index):  # type: ignore[no-untyped-def]
    byte = index >> u64(3)
    bits[byte] = u8(bits[byte] | u8(u64(1) << (index & u64(7))))


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
