"""What the sweeps of a window have seen that the map does not have yet: points, each with the node that saw it."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from companion.core.messages import Array
from companion.estimation.point_map import PointMap
from companion.estimation.voxels import pack, slot_of, table_size

_PER_VOXEL = 8
Flags = NDArray[np.bool_]


class FreshPoints:
    """A sparse grid of points in the body frames of their nodes, placed by the poses at the time of insertion."""

    def __init__(self, capacity: int, *, voxel_m: float, spacing_m: float) -> None:
        self.voxel_m, self._spacing_m = voxel_m, spacing_m
        self.keys = np.zeros(table_size(capacity), np.int64)
        self.first = np.empty(len(self.keys), np.int32)  # of a voxel in the pool
        self.counts = np.zeros(capacity + 1, np.int32)
        self.pool = np.empty((capacity + 1, _PER_VOXEL), np.int32)  # numbers of points
        self.body = np.empty((capacity, 3))  # in the frame of the owner
        self.odom = np.empty((capacity, 3))
        self.owner = np.empty(capacity, np.int64)
        self._voxels = self._points = 0

    def insert(self, body: Array, R: Array, p: Array, owner: int) -> Flags:
        """Points (N, 3) of node `owner` at the pose (R, p); returns which were kept: none is near another."""
        kept = np.zeros(len(body), np.bool_)
        store = (self.keys, self.first, self.counts, self.pool, self.body, self.odom, self.owner)
        limits = 1.0 / self.voxel_m, self._spacing_m**2
        self._voxels, self._points = _insert(store, self._voxels, self._points, body, (R, p), owner, limits, kept)
        return kept

    @property
    def store(self) -> tuple[NDArray[Any], ...]:
        """Arrays for kernels."""
        return self.keys, self.first, self.counts, self.pool, self.body, self.odom, self.owner


def new_to(target: PointMap, body: Array, R: Array, p: Array) -> Flags:
    """Which of the points (N, 3), by R @ x + p, have no point of the map within its spacing, in their voxel."""
    out = np.empty(len(body), np.bool_)
    store, c = (target.keys, target.value, target.counts, target.pool), target.config
    _new_to(store, body, R, p, 1.0 / c.voxel_m, c.spacing_m**2, out)
    return out


@njit(cache=True, nogil=True)
def _carried(body, R, p, q):  # type: ignore[no-untyped-def]
    a, b, c = body[q, 0], body[q, 1], body[q, 2]
    x = R[0, 0] * a + R[0, 1] * b + R[0, 2] * c + p[0]
    y = R[1, 0] * a + R[1, 1] * b + R[1, 2] * c + p[1]
    z = R[2, 0] * a + R[2, 1] * b + R[2, 2] * c + p[2]
    return x, y, z


@njit(cache=True, nogil=True)
def _key(x, y, z, inverse):  # type: ignore[no-untyped-def]
    return pack(np.int64(np.floor(x * inverse)), np.int64(np.floor(y * inverse)), np.int64(np.floor(z * inverse)))


@njit(cache=True, nogil=True)
def _insert(store, voxels, points, body, pose, owner, limits, kept):  # type: ignore[no-untyped-def]
    keys, first, counts, pool, bodies, odom, owners = store
    for q in range(body.shape[0]):
        x, y, z = _carried(body, pose[0], pose[1], q)
        key = _key(x, y, z, limits[0])
        s = slot_of(keys, key)
        if keys[s] == 0:
            keys[s], first[s], counts[voxels] = key, voxels, 0
            voxels += 1
        v = first[s]
        free = counts[v] < pool.shape[1]
        for u in range(counts[v]):
            m = pool[v, u]
            near2 = (odom[m, 0] - x) ** 2 + (odom[m, 1] - y) ** 2 + (odom[m, 2] - z) ** 2
            free = free and near2 >= limits[1]
        if free:
            pool[v, counts[v]] = points
            counts[v] += 1
            odom[points, 0], odom[points, 1], odom[points, 2] = x, y, z
            owners[points] = owner
            for i in range(3):
                bodies[points, i] = body[q, i]
            points += 1
            kept[q] = True
    return voxels, points


@njit(cache=True, nogil=True)
def _new_to(store, body, R, p, inverse, spacing2, out):  # type: ignore[no-untyped-def]
    keys, value, counts, pool = store
    for q in range(body.shape[0]):
        x, y, z = _carried(body, R, p, q)
        s = slot_of(keys, _key(x, y, z, inverse))
        out[q] = True
        if keys[s] == 0:
            continue
        v = value[s]
        for u in range(counts[v]):
            near2 = (pool[v, u, 0] - x) ** 2 + (pool[v, u, 1] - y) ** 2 + (pool[v, u, 2] - z) ** 2
            out[q] = out[q] and near2 >= spacing2
