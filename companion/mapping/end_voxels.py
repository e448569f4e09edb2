"""The voxels in which the points of a scan lie, each once: one ray per voxel instead of one per point.

OctoMap's discrete mode (`discretize` of its `insertPointCloud`).
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from companion.core.messages import Array32
from companion.mapping.rays import ToGrid

u64 = np.uint64


def end_voxels(points: Array32, to_grid: ToGrid, near_m: float) -> tuple[Array32, int]:
    """Centres (K, 3) of the voxels that hold a point, in the order of their first points, and how many points count.

    `points` (N, 3) in body, m. The centres are in voxels, as `to_grid` gives them: halves, so exact up to 2^23.
    Points nearer to the body's origin than `near_m`, at the sensor, or not finite do not count.
    """
    centers = np.empty((len(points), 3), np.float32)
    table = np.full(1 << (2 * len(points) + 1).bit_length(), -1, np.int32)
    count, used = _end_voxels(points, to_grid, near_m, centers, table)
    return centers[:count], int(used)


@njit(cache=True, nogil=True, error_model="numpy")
def _end_voxels(points, to_grid, near, centers, table):  # type: ignore[no-untyped-def]
    """`table` hashes rows of `centers`. Sums are in the order of `ray_lines.ends`: both find the same voxel."""
    R, offset, start = to_grid
    count = used = 0
    for n in range(points.shape[0]):
        a, b, c = (np.float64(points[n, 0]), np.float64(points[n, 1]), np.float64(points[n, 2]))
        dx = R[0, 0] * a + R[0, 1] * b + R[0, 2] * c + offset[0]
        dy = R[1, 0] * a + R[1, 1] * b + R[1, 2] * c + offset[1]
        dz = R[2, 0] * a + R[2, 1] * b + R[2, 2] * c + offset[2]
        length2 = dx * dx + dy * dy + dz * dz
        if (length2 > 0.0) and (length2 < 1e18) and (a * a + b * b + c * c >= near * near):  # NaN fails, too
            used += 1
            cell = (math.floor(start[0] + dx), math.floor(start[1] + dy), math.floor(start[2] + dz))
            centers[count, 0], centers[count, 1], centers[count, 2] = cell[0] + 0.5, cell[1] + 0.5, cell[2] + 0.5
            slot = _slot(cell, centers, count, table)
            if table[slot] < 0:
                table[slot] = count
                count += 1
    return count, used


@njit(cache=True, nogil=True)
def _slot(cell, centers, row, table):  # type: ignore[no-untyped-def]
    """Where the centre of `row`, that of `cell`, is or would go."""
    mask = u64(table.size - 1)
    key = u64(int(cell[0])) * u64(0x9E3779B97F4A7C15) ^ u64(int(cell[1])) * u64(0xC2B2AE3D27D4EB4F)
    key ^= u64(int(cell[2])) * u64(0x165667B19E3779F9)
    slot = (key ^ (key >> u64(29))) & mask
    while table[slot] >= 0 and not _same(centers, table[slot], row):
        slot = (slot + u64(1)) & mask
    return slot


@njit(cache=True, nogil=True)
def _same(centers, i, k):  # type: ignore[no-untyped-def]
    return centers[i, 0] == centers[k, 0] and centers[i, 1] == centers[k, 1] and centers[i, 2] == centers[k, 2]
