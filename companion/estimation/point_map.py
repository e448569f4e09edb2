"""The map that scans are registered against: a few well-spaced points per voxel.

Source: C. Bai et al., "Faster-LIO", RA-L 2022 (sparse voxels of points). Nothing is ever
forgotten: a short map drifts.
"""

from __future__ import annotations

from typing import Annotated

import msgspec
import numpy as np
from numba import njit

from companion.core.messages import Array, Array32
from companion.estimation.voxels import pack, slot_of, table_size

_FIRST_VOXELS = 1 << 15


class PointMapConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Resolution and bound of the map."""

    voxel_m: Annotated[float, msgspec.Meta(gt=0)] = 0.5  # edge of a voxel
    spacing_m: Annotated[float, msgspec.Meta(gt=0)] = 0.15  # between points in a voxel
    points_per_voxel: Annotated[int, msgspec.Meta(ge=5, le=64)] = 8
    averaged: Annotated[int, msgspec.Meta(ge=1, le=200)] = 1  # returns that a point is the mean of, at most
    max_voxels: Annotated[int, msgspec.Meta(ge=1)] = 1_000_000  # about 100 MB; then no more are added


class PointMap:
    """Grows by doubling its hash table; the points lie in a pool that never moves."""

    def __init__(self, config: PointMapConfig) -> None:
        self.config = config
        size = config.max_voxels
        # Not touched until used: the system gives pages on demand.
        self.pool = np.empty((size, config.points_per_voxel, 3), np.float32)
        self.weights = np.empty((size, config.points_per_voxel), np.uint8)  # returns in each point
        self.counts = np.zeros(size, np.int32)
        self._pool_keys = np.empty(size, np.int64)
        self._set_table(min(_FIRST_VOXELS, size))
        self.voxels = 0
        self.refused = 0  # points that found no room

    def insert(self, points_body: Array32, R: Array, p: Array) -> int:
        """Take points (N, 3) to the map by R @ x + p: new where none is near, else into the mean of the nearest.

        Returns how many were new.
        """
        while 2 * (self.voxels + len(points_body)) > len(self.keys) and self.voxels < self.config.max_voxels:
            if len(self.keys) >= table_size(self.config.max_voxels):
                break
            self._set_table(len(self.keys))  # twice as large
            _refill(self._pool_keys[: self.voxels], self.keys, self.value)
        c = self.config
        self.voxels, refused, added = _insert(
            (self.keys, self.value, self._pool_keys, self.counts, self.pool, self.weights, self.voxels),
            points_body,
            (np.ascontiguousarray(R), p),
            (1.0 / c.voxel_m, c.spacing_m**2, c.averaged),
        )
        self.refused += refused
        return int(added)

    def points(self) -> Array32:
        """Every point of the map, (N, 3)."""
        counts = self.counts[: self.voxels]
        inside = np.arange(self.config.points_per_voxel) < counts[:, None]
        taken: Array32 = self.pool[: self.voxels][inside]
        return taken

    def _set_table(self, voxels: int) -> None:
        self.keys = np.zeros(table_size(voxels), np.int64)
        self.value = np.empty(len(self.keys), np.int32)


@njit(cache=True, nogil=True)
def _refill(pool_keys, keys, value):  # type: ignore[no-untyped-def]
    for v in range(pool_keys.shape[0]):
        s = slot_of(keys, pool_keys[v])
        keys[s], value[s] = pool_keys[v], v


@njit(cache=True, nogil=True)
def _insert(store, points, pose, limits):  # type: ignore[no-untyped-def]
    keys, value, pool_keys, counts, pool, weights, voxels = store
    R, p = pose
    inverse, spacing2, averaged = limits
    refused, added = 0, 0
    for q in range(points.shape[0]):
        a, b, c = np.float64(points[q, 0]), np.float64(points[q, 1]), np.float64(points[q, 2])
        x = R[0, 0] * a + R[0, 1] * b + R[0, 2] * c + p[0]
        y = R[1, 0] * a + R[1, 1] * b + R[1, 2] * c + p[1]
        z = R[2, 0] * a + R[2, 1] * b + R[2, 2] * c + p[2]
        i, j, k = (
            np.int64(np.floor(x * inverse)),
            np.int64(np.floor(y * inverse)),
            np.int64(np.floor(z * inverse)),
        )
        key = pack(i, j, k)
        s = slot_of(keys, key)
        if keys[s] == 0:
            if voxels == pool.shape[0]:
                refused += 1
                continue
            keys[s], value[s], pool_keys[voxels] = key, voxels, key
            voxels += 1
        v = value[s]
        n = counts[v]
        nearest, at = spacing2, -1
        for u in range(n):
            dx, dy, dz = pool[v, u, 0] - x, pool[v, u, 1] - y, pool[v, u, 2] - z
            d = dx * dx + dy * dy + dz * dz
            if d < nearest:
                nearest, at = d, u
        if at >= 0:
            if weights[v, at] < averaged:
                weights[v, at] += 1
                share = 1.0 / weights[v, at]
                pool[v, at, 0] += share * (x - pool[v, at, 0])
                pool[v, at, 1] += share * (y - pool[v, at, 1])
                pool[v, at, 2] += share * (z - pool[v, at, 2])
        elif n < pool.shape[1]:
            pool[v, n, 0], pool[v, n, 1], pool[v, n, 2] = x, y, z
            weights[v, n], counts[v] = 1, n + 1
            added += 1
    return voxels, refused, added
