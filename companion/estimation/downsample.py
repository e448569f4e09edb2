"""Thin a cloud on a voxel grid."""

from __future__ import annotations

import numpy as np
from numba import njit

from companion.core.messages import Array, Array32
from companion.estimation.voxels import pack, slot_of, table_size


class Thinner:
    """Keeps the scratch table between scans, since clearing what was used is cheaper."""

    def __init__(self) -> None:
        self._keys = np.zeros(table_size(20_000), np.int64)
        self._value = np.empty(len(self._keys), np.int64)

    def centroids(self, points: Array32, voxel_m: float, *, at_most: int) -> Array:
        """Mean point of each voxel, (M, 3), in order of first sight; evenly thinned to `at_most`."""
        self._fit(len(points))
        out = np.empty((len(points), 3))
        count = _centroids(points, 1.0 / voxel_m, self._keys, self._value, out)
        if count <= at_most:
            return out[:count]
        thinned: Array = out[np.arange(at_most) * count // at_most]
        return thinned

    def firsts(self, points: Array32, voxel_m: float) -> Array32:
        """First point of each voxel, (M, 3)."""
        self._fit(len(points))
        index = np.empty(len(points), np.int64)
        count = _firsts(points, 1.0 / voxel_m, self._keys, index)
        return points[index[:count]]

    def _fit(self, points: int) -> None:
        if 2 * points > len(self._keys):
            self._keys = np.zeros(table_size(points), np.int64)
            self._value = np.empty(len(self._keys), np.int64)


@njit(cache=True, nogil=True)
def _centroids(points, inverse, keys, value, out):  # type: ignore[no-untyped-def]
    n = points.shape[0]
    used, weight = np.empty(n, np.uint64), np.empty(n, np.int64)
    m = 0
    for q in range(n):
        s, key = _voxel(points, q, inverse, keys)
        if keys[s] == 0:
            keys[s], value[s], used[m], weight[m] = key, m, s, 0
            out[m, 0] = out[m, 1] = out[m, 2] = 0.0
            m += 1
        v = value[s]
        weight[v] += 1
        for i in range(3):
            out[v, i] += (points[q, i] - out[v, i]) / weight[v]
    for u in range(m):
        keys[used[u]] = 0
    return m


@njit(cache=True, nogil=True)
def _firsts(points, inverse, keys, index):  # type: ignore[no-untyped-def]
    n = points.shape[0]
    used = np.empty(n, np.uint64)
    m = 0
    for q in range(n):
        s, key = _voxel(points, q, inverse, keys)
        if keys[s] == 0:
            keys[s], used[m], index[m] = key, s, q
            m += 1
    for u in range(m):
        keys[used[u]] = 0
    return m


@njit(cache=True, nogil=True)
def _voxel(points, q, inverse, keys):  # type: ignore[no-untyped-def]
    i = np.int64(np.floor(points[q, 0] * inverse))
    j = np.int64(np.floor(points[q, 1] * inverse))
    k = np.int64(np.floor(points[q, 2] * inverse))
    key = pack(i, j, k)
    return slot_of(keys, key), key
