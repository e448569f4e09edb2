"""The local map: states, exact truncated distances and ground height in a box around the vehicle.

It is rebuilt whole, which costs less than keeping it up to date, and gives a snapshot that
nobody changes. Squared distances are separable (Felzenszwalb and Huttenlocher, "Distance
transforms of sampled functions", 2012); as they are truncated, each pass is a short minimum
over shifted copies, in the smallest integers that hold them.
"""

from __future__ import annotations

import math
from typing import Annotated

import msgspec
import numpy as np
from numba import njit
from numpy.typing import NDArray

from companion.core.errors import InputError
from companion.core.messages import Array, Array32, LocalMap, freeze
from companion.mapping.rays import BLOCK
from companion.mapping.voxel_map import FREE_CELL, OCCUPIED_CELL, VoxelMap

_Metres = Annotated[float, msgspec.Meta(gt=0.0)]
_PLANE = BLOCK * BLOCK  # divides every plane of a box of whole blocks
_CHUNK = 256  # cells whose minima stay in registers
_FARTHEST_CELLS = 100  # squares fit 16 bits
_BYTE_CELLS = 10  # squares and their sums fit 8 bits
_NEAREST_OCCUPIED = (0, 2)  # a state counts if (state ^ first) & second
_NEAREST_NOT_FREE = (1, 3)
_NOT_ASKED_FOR = np.empty((0, 0, 0), np.float32)


class FieldConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The box around the vehicle; sizes are rounded up to whole blocks of 8 voxels."""

    size_m: tuple[_Metres, _Metres, _Metres] = (40.0, 40.0, 10.0)
    truncation_m: _Metres = 2.0  # distances end here
    ground_slope: _Metres = 1.0  # rise over run; what stands steeper above seen ground is no ground
    ground_step_m: Annotated[float, msgspec.Meta(ge=0.0)] = 0.4  # height that is still ground at any slope


class DistanceField:
    """Builds snapshots; keeps only scratch, so each depends on the map alone.

    >>> field = DistanceField(FieldConfig(), resolution_m=0.2)
    >>> local_map = field.around(voxels, p_odom, stamp_ns=0)
    """

    def __init__(self, config: FieldConfig, *, resolution_m: float) -> None:
        self.config = config
        self.resolution_m = resolution_m
        self._blocks = np.array([math.ceil(s / (BLOCK * resolution_m) - 1e-9) for s in config.size_m])
        nx, ny, nz = self.shape = tuple(int(n) for n in BLOCK * self._blocks)
        self._reach = math.floor(config.truncation_m / resolution_m + 0.5 + 1e-9)
        if not 1 <= self._reach <= _FARTHEST_CELLS:
            raise InputError(
                f"{config.truncation_m} m are {self._reach} voxels",
                field="mapping.field.truncation_m",
                valid=f"1 to {_FARTHEST_CELLS} voxels of {resolution_m} m",
            )
        kind = np.uint8 if self._reach <= _BYTE_CELLS else np.uint16
        self._along_x = np.empty((nx, ny, nz), kind)
        padded = (ny + 2 * self._reach) * (nz + self._reach) + self._reach + _CHUNK
        self._slabs = np.empty((3, padded), kind)

    def around(self, voxels: VoxelMap, center_odom: Array, stamp_ns: int, *, unknown: bool = True) -> LocalMap:
        """The snapshot in the box whose middle block holds `center_odom` (3,).

        A distance is that from the cell's centre to the nearest such cell's centre, less half
        a cell for that cell's surface, within 0 .. truncation_m. Cells beyond the box do not
        count. Arrays are new and read-only. Without `unknown` the distance to what is not known
        free is left out, which is half of the work.
        """
        edge_m = BLOCK * self.resolution_m
        corner = np.floor(center_odom / edge_m).astype(np.int64) - self._blocks // 2
        states = np.empty(self.shape, np.uint8)
        voxels.window(corner, states)
        snapshot = LocalMap(
            stamp_ns=stamp_ns,
            origin_odom=corner * edge_m,
            resolution_m=self.resolution_m,
            state=states,
            distance_m=self.distance_to_occupied(states),
            unknown_distance_m=self._distances(states, _NEAREST_NOT_FREE) if unknown else _NOT_ASKED_FOR,
            ground_z_odom=self._ground(states, corner[2] * edge_m),
        )
        freeze(snapshot)
        return snapshot

    def distance_to_occupied(self, states: NDArray[np.uint8]) -> Array32:
        """Distance (X, Y, Z) of each cell of a box of `shape` to the nearest occupied one, m, as in `around`."""
        return self._distances(states, _NEAREST_OCCUPIED)

    def _distances(self, states: NDArray[np.uint8], chosen: tuple[int, int]) -> Array32:
        out = np.empty(states.shape, np.float32)
        metres = np.array([self.resolution_m, self.config.truncation_m], np.float32)
        _distances(states, chosen, self._reach, (self._along_x, self._slabs), metres, out)
        return out

    def _ground(self, states: NDArray[np.uint8], bottom_m: float) -> Array32:
        """Height (X, Y) of the centre of each column's ground cell, m; NaN: none seen.

        It is the lowest occupied cell with free space right above, unless it stands above
        ground seen nearby steeper than `ground_slope` (a trunk, a crown).
        """
        cells = np.full(states.shape[:2], np.inf, np.float32)
        step = np.float32(self.config.ground_step_m / self.resolution_m)
        _lowest_tops(states, states.view(np.uint64), cells)
        _drop_steep(cells.copy(), np.float32(self.config.ground_slope), step, cells)
        ground: Array32 = ((cells + 0.5) * self.resolution_m + bottom_m).astype(np.float32)
        return ground


def interpolate(field: Array32, local_map: LocalMap, points_odom: Array) -> Array:
    """Trilinear value (N,) of a field (X, Y, Z) of a local map at points (N, 3), m.

    Beyond the outermost cell centres the nearest value on them holds.
    """
    last = np.array(field.shape) - 1
    cell = (points_odom - local_map.origin_odom) / local_map.resolution_m - 0.5
    cell = np.clip(cell, 0.0, last)
    low = np.minimum(cell.astype(np.int64), np.maximum(last - 1, 0))
    part = cell - low
    value = np.zeros(len(cell))
    for corner in range(8):
        bit = np.array([corner >> 2 & 1, corner >> 1 & 1, corner & 1])
        x, y, z = np.minimum(low + bit, last).T
        value += np.prod(np.where(bit == 1, part, 1.0 - part), axis=1) * field[x, y, z]
    return value


@njit(cache=True, nogil=True)
def _distances(states, chosen, reach, scratch, metres, out):  # type: ignore[no-untyped-def]
    """x by two sweeps over the box, then slab by slab y and z by shifted minima, then metres."""
    along_x, slabs = scratch
    _sweep(states.reshape(states.shape[0], -1), chosen, reach, along_x.reshape(states.shape[0], -1))
    ny, nz = states.shape[1], states.shape[2]
    stride = nz + reach  # a gap between rows keeps the shifts along z apart
    first = reach * stride + reach
    squares, along_y, along_z = slabs[0], slabs[1], slabs[2]
    whole = slabs.dtype.type
    slabs[:] = whole((reach + 1) * (reach + 1))
    for i in range(states.shape[0]):
        for j in range(ny):
            row = squares[first + j * stride : first + j * stride + nz]
            source = along_x[i, j]
            for k in range(nz):
                row[k] = whole(source[k] * source[k])
        _shifted_minima(squares, along_y, (first, first + ny * stride), stride, reach)
        _shifted_minima(along_y, along_z, (first, first + ny * stride), 1, reach)
        for j in range(ny):
            _metres(along_z[first + j * stride : first + j * stride + nz], metres, out[i, j])


@njit(cache=True, nogil=True)
def _sweep(states, chosen, reach, steps):  # type: ignore[no-untyped-def]
    """Distance along axis 0 to the nearest chosen state, in cells, at most reach + 1."""
    flip, mask, none = np.uint8(chosen[0]), np.uint8(chosen[1]), np.uint8(0)
    whole = steps.dtype.type
    cap, one, zero = whole(reach + 1), whole(1), whole(0)
    for i in range(states.shape[0]):
        for first in range(0, states.shape[1], _PLANE):
            row, state = steps[i, first : first + _PLANE], states[i, first : first + _PLANE]
            before = steps[max(i - 1, 0), first : first + _PLANE]
            for n in range(_PLANE):
                far = whole(before[n] + one) if i > 0 else cap
                far = far if far < cap else cap
                row[n] = zero if ((state[n] ^ flip) & mask) != none else far
    for i in range(states.shape[0] - 2, -1, -1):
        for first in range(0, states.shape[1], _PLANE):
            row, after = steps[i, first : first + _PLANE], steps[i + 1, first : first + _PLANE]
            for n in range(_PLANE):
                far = whole(after[n] + one)
                row[n] = far if far < row[n] else row[n]


@njit(cache=True, nogil=True)
def _shifted_minima(source, target, span, stride, reach):  # type: ignore[no-untyped-def]
    """target[i] = min over |k| <= reach of source[i + k * stride] + k^2, for i in whole chunks of span."""
    whole = source.dtype.type
    for first in range(span[0], span[1], _CHUNK):
        out, middle = target[first : first + _CHUNK], source[first : first + _CHUNK]
        for n in range(_CHUNK):
            out[n] = middle[n]
        for k in range(1, reach + 1):
            square = whole(k * k)
            below = source[first - k * stride : first - k * stride + _CHUNK]
            above = source[first + k * stride : first + k * stride + _CHUNK]
            for n in range(_CHUNK):
                near = below[n] if below[n] < above[n] else above[n]
                near = whole(near + square)
                out[n] = near if near < out[n] else out[n]


@njit(cache=True, nogil=True)
def _metres(squares, metres, out):  # type: ignore[no-untyped-def]
    cell, most = metres[0], metres[1]
    half, zero = np.float32(0.5), np.float32(0.0)
    for k in range(squares.size):
        out[k] = min(max((np.sqrt(np.float32(squares[k])) - half) * cell, zero), most)


@njit(cache=True, nogil=True)
def _lowest_tops(states, words, cells):  # type: ignore[no-untyped-def]
    """Index of the lowest occupied cell with a free one on it, per column; inf stays: none."""
    nx, ny, nz = states.shape
    occupied = np.uint64(0x0202020202020202)
    for i in range(nx):
        for j in range(ny):
            for w in range(words.shape[2]):
                if (words[i, j, w] & occupied) == np.uint64(0) or cells[i, j] != np.inf:
                    continue
                for k in range(BLOCK * w, min(BLOCK * w + BLOCK, nz - 1)):
                    if states[i, j, k] == OCCUPIED_CELL and states[i, j, k + 1] == FREE_CELL:
                        cells[i, j] = k
                        break


@njit(cache=True, nogil=True)
def _drop_steep(lowest, slope, step, cells):  # type: ignore[no-untyped-def]
    """NaN for cells more than `step` above the lower envelope of cones of that slope; and for inf.

    The distance is |dx| + |dy|, for which two sweeps are exact.
    """
    nx, ny = lowest.shape
    for i in range(nx):
        for j in range(ny):
            left = lowest[max(i - 1, 0), j]
            down = lowest[i, max(j - 1, 0)]
            lowest[i, j] = min(lowest[i, j], min(left, down) + slope)
    for i in range(nx - 1, -1, -1):
        for j in range(ny - 1, -1, -1):
            right = lowest[min(i + 1, nx - 1), j]
            up = lowest[i, min(j + 1, ny - 1)]
            lowest[i, j] = min(lowest[i, j], min(right, up) + slope)
            if not cells[i, j] <= lowest[i, j] + step or cells[i, j] == np.inf:
                cells[i, j] = np.nan
