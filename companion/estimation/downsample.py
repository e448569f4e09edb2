"""Thin a cloud on a voxel grid."""

from __future__ import annotations

import numpy as np
from numba import njit

from companion.core.messages import Array, Array32
from companion.core.prefetch import prefetch
from companion.estimation.voxels import home_of, pack, slot_of, table_size

_AT_ONCE = 64  # points


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
    used, weight, of = np.empty(n, np.uint64), np.empty(n, np.int64), np.empty(_AT_ONCE, np.int64)
    m = 0
    for q in range(n):
        if q % _AT_ONCE == 0:
            _ask_for_voxels(points[q : q + _AT_ONCE], inverse, keys, of)
        key = of[q % _AT_ONCE]
        s = slot_of(keys, key)
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
    used, of = np.empty(n, np.uint64), np.empty(_AT_ONCE, np.int64)
    m = 0
    for q in range(n):
        if q % _AT_ONCE == 0:
            _ask_for_voxels(points[q : q + _AT_ONCE], inverse, keys, of)
        key = of[q % _AT_ONCE]
        s = slot_of(keys, key)
        if keys[s] == 0:
            keys[s], used[m], index[m] = key, s, q
            m += 1
    for u in range(m):
        keys[used[u]] = 0
    return m


@njit(cache=True, nogil=True)
def _ask_for_voxels(points, inverse, keys, of):  # type: ignore[no-untyped-def]
    """Keys of the voxels that hold the points, and their places in the table asked of the memory."""
    for m in range(points.shape[0]):
        i = np.int64(np.floor(points[m, 0] * inverse))
        j = np.int64(np.floor(points[m, 1] * inverse))
        k = np.int64(np.floor(points[m, 2] * inverse))
        of[m] = pack(i, j, k)
        prefetch(keys, home_of(keys, of[m]))
