"""Rays as straight lines through the planes between voxels, many at once, in fixed point.

Three passes over a tile of rays, none with branches, so that the compiler takes eight at a time.
Their results lie in scratch arrays `lines` = (ways, fixed, cut, whole), a part of TILE numbers for each quantity;
`cut` is `fixed` in 32 bits.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from companion.core.messages import Array
from companion.mapping.lanes import FRACTION, LANES

u32, u64 = np.uint32, np.uint64
TILE = 256  # rays prepared at once
FINE = 44  # bits after the point: an error of 2e-11 voxels after 300 planes
COUNT, LAST, PLACE, HITS, _CUT_OFF = (k * TILE for k in (0, 3, 6, 9, 10))  # parts of `whole`
CUT_BITS = FINE - FRACTION
_ONE = float(1 << FINE)
_STEEPEST = 1024.0  # slope bound; a steeper family has a single voxel, whose slope does not matter


def line_scratch() -> tuple[Array, NDArray[np.uint64], NDArray[np.uint32], NDArray[np.int64]]:
    """Arrays that the kernels below fill for up to TILE rays."""
    fixed = np.zeros(12 * TILE, np.uint64)
    return np.zeros(9 * TILE), fixed, np.zeros(12 * TILE, np.uint32), np.zeros(11 * TILE, np.int64)


@njit(cache=True, nogil=True, error_model="numpy")
def ends(vectors, span, pose, ranges, lines):  # type: ignore[no-untyped-def]
    """For each ray its way in voxels, at most `far` long, and the voxel of its end; returns how many count.

    `vectors` are flat, because the compiler does not take rows of three for contiguous. Nor does it take
    several rays at once if this loop has branches or more parts.
    """
    (r00, r01, r02, r10, r11, r12, r20, r21, r22), (px, py, pz), (ox, oy, oz) = pose
    near, far, miss = ranges
    ways, _, _, whole = lines
    first, used = u64(span[0]), 0
    near2, far2 = near * near, far * far
    for m in range(span[1]):
        n = u64(m)
        i = u64(3) * (first + n)
        a, b, c = (np.float64(vectors[i]), np.float64(vectors[i + u64(1)]), np.float64(vectors[i + u64(2)]))
        dx = r00 * a + r01 * b + r02 * c + px
        dy = r10 * a + r11 * b + r12 * c + py
        dz = r20 * a + r21 * b + r22 * c + pz
        length2 = dx * dx + dy * dy + dz * dz
        counts = (length2 > 0.0) & (length2 < 1e18) & (a * a + b * b + c * c >= near2)  # NaN fails, too
        cut = miss | (length2 > far2)
        shrink = far / math.sqrt(length2) if cut else 1.0
        dx, dy, dz = dx * shrink, dy * shrink, dz * shrink
        dx, dy, dz = ((dx if counts else 0.0), (dy if counts else 0.0), (dz if counts else 0.0))
        ways[n] = dx
        ways[u64(TILE) + n] = dy
        ways[u64(2 * TILE) + n] = dz
        whole[u64(LAST) + n] = int(ox + dx)
        whole[u64(LAST + TILE) + n] = int(oy + dy)
        whole[u64(LAST + 2 * TILE) + n] = int(oz + dz)
        whole[u64(_CUT_OFF) + n] = 1 if counts & cut else 0
        whole[u64(HITS) + n] = 1 if counts & (not cut) else 0
        used += 1 if counts else 0
    return used


@njit(cache=True, nogil=True, error_model="numpy")
def planes(count, start, lines, cells):  # type: ignore[no-untyped-def]
    """For each ray the planes that it crosses on each axis, less the one of a cut: OctoMap does not see that voxel.

    And the place of the first one's share of an index, among those of an axis with `cells`, upwards or downwards.
    `ways` get the ray's shares up to the first plane and from plane to plane behind the way itself.
    """
    ox, oy, oz = start
    ways, _, _, whole = lines
    ix, iy, iz = int(ox), int(oy), int(oz)
    up, down = LANES + 1, 2 * cells - LANES
    for m in range(count):
        n = u64(m)
        dx, dy, dz = ways[n], ways[u64(TILE) + n], ways[u64(2 * TILE) + n]
        gx, gy, gz = 1.0 / abs(dx), 1.0 / abs(dy), 1.0 / abs(dz)
        tx = (ix + 1 - ox if dx > 0 else ox - ix) * gx
        ty = (iy + 1 - oy if dy > 0 else oy - iy) * gy
        tz = (iz + 1 - oz if dz > 0 else oz - iz) * gz
        nx = abs(whole[u64(LAST) + n] - ix)
        ny = abs(whole[u64(LAST + TILE) + n] - iy)
        nz = abs(whole[u64(LAST + 2 * TILE) + n] - iz)
        last_x = tx + (nx - 1) * gx if nx > 0 else -1.0
        last_y = ty + (ny - 1) * gy if ny > 0 else -1.0
        last_z = tz + (nz - 1) * gz if nz > 0 else -1.0
        x_last = (last_x >= last_y) & (last_x >= last_z)
        y_last = (last_y >= last_z) & (not x_last)
        drop = (whole[u64(_CUT_OFF) + n] != 0) & (nx + ny + nz > 0)
        whole[u64(COUNT) + n] = nx - (1 if drop & x_last else 0)
        whole[u64(COUNT + TILE) + n] = ny - (1 if drop & y_last else 0)
        whole[u64(COUNT + 2 * TILE) + n] = nz - (1 if drop & (not x_last) & (not y_last) else 0)
        whole[u64(PLACE) + n] = up + ix if dx > 0 else down - ix
        whole[u64(PLACE + TILE) + n] = up + 2 * cells + iy if dy > 0 else down + 2 * cells - iy
        whole[u64(PLACE + 2 * TILE) + n] = up + 4 * cells + iz if dz > 0 else down + 4 * cells - iz
        ways[u64(3 * TILE) + n], ways[u64(4 * TILE) + n], ways[u64(5 * TILE) + n] = (tx, ty, tz)
        ways[u64(6 * TILE) + n], ways[u64(7 * TILE) + n], ways[u64(8 * TILE) + n] = (gx, gy, gz)


@njit(cache=True, nogil=True, error_model="numpy")
def slopes(count, start, lines, axis):  # type: ignore[no-untyped-def]
    """For the planes of an axis: u and v, the other two, where a ray crosses the first, and per plane."""
    ways, fixed, _, _ = lines
    axis_u, axis_v = 1 if axis == 0 else 0, 1 if axis == 2 else 2
    u0, v0 = start[axis_u], start[axis_v]
    of_u, of_v, at_t, at_g = (axis_u * TILE, axis_v * TILE, (3 + axis) * TILE, (6 + axis) * TILE)
    for n in range(count):
        du, dv, t, gap = ways[of_u + n], ways[of_v + n], ways[at_t + n], ways[at_g + n]
        at = u64(4 * axis * TILE + n)
        fixed[at] = _fixed(u0 + du * t)
        fixed[at + u64(TILE)] = _fixed(v0 + dv * t)
        fixed[at + u64(2 * TILE)] = _fixed(min(max(du * gap, -_STEEPEST), _STEEPEST))
        fixed[at + u64(3 * TILE)] = _fixed(min(max(dv * gap, -_STEEPEST), _STEEPEST))


@njit(cache=True, nogil=True)
def cut_bits(lines):  # type: ignore[no-untyped-def]
    """`cut` from `fixed`."""
    _, fixed, cut, _ = lines
    for n in range(fixed.size):
        cut[n] = u32(fixed[n] >> u64(CUT_BITS))


@njit(cache=True, nogil=True)
def _fixed(x):  # type: ignore[no-untyped-def]
    return u64(np.int64(x * _ONE))
