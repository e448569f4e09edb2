"""Triangles of solids: boxes, large faces cut small, and the skin of an implicit body."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from companion.core.messages import Array

_UNIT = np.array([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])
_FACES = np.array(
    [
        [0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1],
        [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3],
    ]
)  # fmt: skip


def box_triangles(middles: Array, halves: Array) -> Array:
    """Upright boxes about `middles` (K, 3) with half sides (K, 3), m -> triangles (12 K, 3, 3)."""
    corners = middles[:, None] + _UNIT * halves[:, None]
    return np.asarray(corners[:, _FACES].reshape(-1, 3, 3))


def cut_small(triangles: Array, longest_m: float) -> Array:
    """Halve triangles (T, 3, 3) across their longest side until none is longer than that."""
    done: list[Array] = []
    while len(triangles):
        sides = np.linalg.norm(triangles - np.roll(triangles, -1, axis=1), axis=2)
        small = sides.max(axis=1) <= longest_m
        done.append(triangles[small])
        triangles, sides = triangles[~small], sides[~small]
        turn = (np.argmax(sides, axis=1)[:, None] + np.arange(3)) % 3
        a, b, c = np.moveaxis(np.take_along_axis(triangles, turn[..., None], axis=1), 1, 0)
        middle = (a + b) / 2
        triangles = np.concatenate([np.stack([a, middle, c], axis=1), np.stack([middle, b, c], axis=1)])
    return np.concatenate(done) if done else triangles


def skin(field: Array, origin: Array, cell_m: float) -> Array:
    """Triangles (T, 3, 3) where a field (nx, ny, nz), sampled at origin + (i, j, k) * cell, changes sign.

    Surface nets: one corner in each cell that the skin crosses, at the mean of the crossings on
    its edges (S. Gibson, "Constrained Elastic SurfaceNets", MICCAI 1998).
    """
    total, count = np.zeros((*field.shape, 3)), np.zeros(field.shape)
    quads = [_crossings(field, axis, total, count) for axis in range(3)]
    middle = total / np.maximum(count, 1.0)[..., None] * cell_m + origin
    corners = np.concatenate([middle[q[..., 0], q[..., 1], q[..., 2]] for q in quads])
    return np.concatenate([corners[:, [0, 1, 2]], corners[:, [0, 2, 3]]])


def _crossings(field: Array, axis: int, total: Array, count: Array) -> NDArray[np.int64]:
    """Add the crossings on all edges along an axis to the cells around; cells (Q, 4, 3) around each."""
    low, high = np.moveaxis(field, axis, 0)[:-1], np.moveaxis(field, axis, 0)[1:]
    at = np.stack(np.nonzero((low < 0) != (high < 0)), axis=1)
    a, b = low[tuple(at.T)], high[tuple(at.T)]
    edge = np.insert(at[:, 1:], axis, at[:, 0], axis=1)
    u, v = (k for k in range(3) if k != axis)
    inside = (edge[:, u] > 0) & (edge[:, v] > 0)
    edge, a, b = edge[inside], a[inside], b[inside]
    crossing = edge.astype(np.float64)
    crossing[:, axis] += a / (a - b)
    cells: NDArray[np.int64] = np.repeat(edge[:, None], 4, axis=1)
    for corner, (du, dv) in enumerate(((0, 0), (1, 0), (1, 1), (0, 1))):
        cells[:, corner, u] -= du
        cells[:, corner, v] -= dv
        where = tuple(cells[:, corner].T)
        np.add.at(total, where, crossing)
        np.add.at(count, where, 1.0)
    return cells
