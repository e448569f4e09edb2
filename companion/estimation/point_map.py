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
from companion.core.prefetch import prefetch
from companion.estimation.voxels import home_of, pack, slot_of, table_size

_FIRST_VOXELS = 1 << 15
_AT_ONCE = 64  # points


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
    """Some points at once, in three passes: what the next will need is asked of the memory by the one before."""
    at, of = np.empty((_AT_ONCE, 3)), np.empty(_AT_ONCE, np.int64)  # points in odom, keys of their voxels
    voxels, refused, added = store[6], 0, 0
    for first in range(0, points.shape[0], _AT_ONCE):
        count = min(_AT_ONCE, points.shape[0] - first)
        _carry(store, points[first : first + count], pose, limits[0], at, of)
        _ask_for_voxels(store, of[:count])
        voxels, lost, new = _put(store, voxels, at, of[:count], limits)
        refused += lost
        added += new
    return voxels, refused, added


@njit(cache=True, nogil=True)
def _carry(store, points, pose, inverse, at, of):  # type: ignore[no-untyped-def]
    (keys, value, _, _, _, _, _), (R, p) = store, pose
    for m in range(points.shape[0]):
        a, b, c = np.float64(points[m, 0]), np.float64(points[m, 1]), np.float64(points[m, 2])
        x = R[0, 0] * a + R[0, 1] * b + R[0, 2] * c + p[0]
        y = R[1, 0] * a + R[1, 1] * b + R[1, 2] * c + p[1]
        z = R[2, 0] * a + R[2, 1] * b + R[2, 2] * c + p[2]
        at[m, 0], at[m, 1], at[m, 2] = x, y, z
        i, j, k = np.floor(x * inverse), np.floor(y * inverse), np.floor(z * inverse)
        of[m] = pack(np.int64(i), np.int64(j), np.int64(k))
        home = home_of(keys, of[m])
        prefetch(keys, home)
        prefetch(value, home)


@njit(cache=True, nogil=True)
def _ask_for_voxels(store, of):  # type: ignore[no-untyped-def]
    keys, value, _, counts, pool, weights, _ = store
    per = pool.shape[1]
    for m in range(of.size):
        s = slot_of(keys, of[m])
        v = np.int64(value[s]) if keys[s] != 0 else 0
        prefetch(counts, v)
        prefetch(weights, v * per)
        prefetch(pool, v * per * 3)
        prefetch(pool, v * per * 3 + per * 3 - 1)


@njit(cache=True, nogil=True)
def _put(store, voxels, at, of, limits):  # type: ignore[no-untyped-def]
    """Each into the mean of the nearest within the spacing, else a new point of its voxel, if there is room."""
    (keys, value, pool_keys, counts, pool, weights, _), (_, spacing2, averaged) = store, limits
    refused = added = 0
    for m in range(of.size):
        s = slot_of(keys, of[m])
        if keys[s] == 0:
            if voxels == pool.shape[0]:
                refused += 1
                continue
            keys[s], value[s], pool_keys[voxels] = of[m], voxels, of[m]
            voxels += 1
        v = value[s]
        n = counts[v]
        nearest, by = spacing2, -1
        for u in range(n):
            dx, dy, dz = pool[v, u, 0] - at[m, 0], pool[v, u, 1] - at[m, 1], pool[v, u, 2] - at[m, 2]
            d = dx * dx + dy * dy + dz * dz
            if d < nearest:
                nearest, by = d, u
        if by < 0 and n < pool.shape[1]:
            for i in range(3):
                pool[v, n, i] = at[m, i]
            weights[v, n], counts[v] = 1, n + 1
            added += 1
        elif by >= 0 and weights[v, by] < averaged:
            weights[v, by] += 1
            share = 1.0 / weights[v, by]
            for i in range(3):
                pool[v, by, i] += share * (at[m, i] - pool[v, by, i])
    return voxels, refused, added
