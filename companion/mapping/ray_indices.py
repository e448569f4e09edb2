"""Indices of the voxels that rays enter, sixteen planes at once.

They are numbers of bits in a grid of blocks of 8^3 cells, one block after another.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from companion.mapping.lanes import LANES, write_indices
from companion.mapping.ray_lines import COUNT, CUT_BITS, FINE, PLACE, TILE

u32, u64 = np.uint32, np.uint64


@njit(cache=True, nogil=True, error_model="numpy")
def families(rows, count, lines, layout):  # type: ignore[no-untyped-def]
    """Indices of the voxels that `count` rays enter, at the planes of one axis after another; returns their end.

    Writes whole lanes, so garbage may follow.
    """
    side = u32(layout[1])
    x, y, z = (0, u32(6), u32(side * side)), (1, u32(3), side), (2, u32(0), u32(1))
    end = _family(rows, (0, count), lines, layout, (0, y, z))
    end = _family(rows, (end, count), lines, layout, (1, x, z))
    return _family(rows, (end, count), lines, layout, (2, x, y))


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _family(rows, span, lines, layout, axes):  # type: ignore[no-untyped-def]
    """Those at the planes of one axis, from `row[end]` on; inlined, so that the axes are constants.

    Rays of which a lane may be wrong are done again when all are: a call in between, however rare, would have
    the compiler keep every vector in memory.
    """
    (row, doubts), (end, count), (_, fixed, cut, whole), (_, _, along) = rows, span, lines, layout
    axis, (axis_u, bit_u, apart_u), (axis_v, bit_v, apart_v) = axes
    shares, at, doubted = along.reshape(-1), u64(4 * axis * TILE), u64(0)
    for m in range(count):
        n = u64(m)
        crossed, place = whole[u64(COUNT + axis * TILE) + n], u64(whole[u64(PLACE + axis * TILE) + n])
        in_u = (cut[at + u64(2 * TILE) + n], bit_u, apart_u)
        in_v = (cut[at + u64(3 * TILE) + n], bit_v, apart_v)
        now = (cut[at + n], cut[at + u64(TILE) + n])
        unsure = write_indices(row, end, now, in_u, in_v, shares, place)
        u, v = fixed[at + n], fixed[at + u64(TILE) + n]
        u_step, v_step = fixed[at + u64(2 * TILE) + n], fixed[at + u64(3 * TILE) + n]
        for k in range(1, (crossed + LANES - 1) // LANES):
            u, v, place = u + u64(LANES) * u_step, v + u64(LANES) * v_step, place + u64(LANES)
            now = (u32(u >> u64(CUT_BITS)), u32(v >> u64(CUT_BITS)))
            unsure |= write_indices(row, end + LANES * k, now, in_u, in_v, shares, place)
        doubts[doubted], doubts[u64(TILE) + doubted] = m, end
        doubted += u64(unsure != u64(0))
        end += crossed
    for k in range(doubted):
        _exact(row, (doubts[k], doubts[u64(TILE) + u64(k)]), lines, layout, (axis, axis_u, axis_v))
    return end


@njit(cache=True, nogil=True, error_model="numpy")
def _exact(row, of, lines, layout, axes):  # type: ignore[no-untyped-def]
    """The indices of one ray in full precision."""
    (n, first), (_, fixed, _, whole), (strides, _, along), (axis, axis_u, axis_v) = of, lines, layout, axes
    place, at = u64(whole[PLACE + axis * TILE + n]), 4 * axis * TILE + n
    u, v, u_step, v_step = fixed[at], fixed[at + TILE], fixed[at + 2 * TILE], fixed[at + 3 * TILE]
    su, bu, sv, bv = strides[0, axis_u], strides[1, axis_u], strides[0, axis_v], strides[1, axis_v]
    for j in range(whole[COUNT + axis * TILE + n]):
        k = u64(j)
        iu = np.int64((u + k * u_step) >> u64(FINE))
        iv = np.int64((v + k * v_step) >> u64(FINE))
        share = along.reshape(-1)[place + k]
        row[first + j] = u32(share + iu * su + (iu >> 3) * bu + iv * sv + (iv >> 3) * bv)
