"""From a rough guess to one that registration can start from: try small motions, count the points that hit.

Source: E. Olson, "Real-Time Correlative Scan Matching", ICRA 2009; here in space, over a hash of
cells, each with its six neighbours, instead of an image.
"""

from __future__ import annotations

import math
from typing import Annotated

import msgspec
import numpy as np
from numba import njit

from companion.core.messages import Array, Array32
from companion.estimation.downsample import Thinner
from companion.estimation.voxels import pack, slot_of, table_size

Positive = Annotated[float, msgspec.Meta(gt=0)]


class CorrelateConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The motions that are tried about a guess."""

    cell_m: Positive = 0.25  # a point hits if the map has one in its cell or beside it
    reach_m: Positive = 0.75  # in x and y
    step_m: Positive = 0.25
    rise_m: Positive = 0.2  # up and down, once each
    turn_rad: Positive = 0.1
    turn_step_rad: Positive = 0.033
    thin_m: Positive = 0.6  # of the view
    points: Annotated[int, msgspec.Meta(ge=50)] = 400


class HitMap:
    """Cells of a cloud (N, 3), m, and of their neighbours."""

    def __init__(self, points: Array32, config: CorrelateConfig) -> None:
        self.config = config
        cells = np.unique(np.floor(points / config.cell_m).astype(np.int64), axis=0)
        self._keys = np.zeros(table_size(7 * len(cells)), np.int64)
        _fill(cells, self._keys)

    def thinned(self, view: Array32) -> Array:
        """The points of a view (N, 3) that are tried."""
        return Thinner().centroids(view, self.config.thin_m, at_most=self.config.points)

    def refined(self, points: Array, p: Array, yaw: float) -> tuple[Array, float, float]:
        """The motion (p, yaw) about a guess under which most points (N, 3) hit, and their share."""
        c = self.config
        steps = np.arange(-round(c.reach_m / c.step_m), round(c.reach_m / c.step_m) + 1) * c.step_m
        turns = np.arange(-round(c.turn_rad / c.turn_step_rad), round(c.turn_rad / c.turn_step_rad) + 1)
        rises = np.array([-c.rise_m, 0.0, c.rise_m])
        tried = (yaw + turns * c.turn_step_rad, steps, rises)
        turn, x, y, z, hits = _search(self._keys, points, np.asarray(p, np.float64), tried, 1.0 / c.cell_m)
        return np.array([x, y, z]), float(turn), hits / max(len(points), 1)


@njit(cache=True, nogil=True)
def _fill(cells, keys):  # type: ignore[no-untyped-def]
    for n in range(cells.shape[0]):
        i, j, k = cells[n]
        for a, b, c in ((0, 0, 0), (1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1)):
            key = pack(i + a, j + b, k + c)
            keys[slot_of(keys, key)] = key


@njit(cache=True, nogil=True)
def _search(keys, points, p, tried, inverse):  # type: ignore[no-untyped-def]
    """Best of all motions; of equals the first."""
    yaws, steps, rises = tried
    best, most = (yaws[0], p[0], p[1], p[2]), -1
    turned = np.empty_like(points)
    for yaw in yaws:
        c, s = math.cos(yaw), math.sin(yaw)
        for n in range(points.shape[0]):
            turned[n, 0] = c * points[n, 0] - s * points[n, 1]
            turned[n, 1] = s * points[n, 0] + c * points[n, 1]
            turned[n, 2] = points[n, 2]
        for dx in steps:
            for dy in steps:
                for dz in rises:
                    hits = _hits(keys, turned, (p[0] + dx, p[1] + dy, p[2] + dz), inverse, most)
                    if hits > most:
                        best, most = (yaw, p[0] + dx, p[1] + dy, p[2] + dz), hits
    return best[0], best[1], best[2], best[3], most


@njit(cache=True, nogil=True)
def _hits(keys, points, p, inverse, most):  # type: ignore[no-untyped-def]
    """Points that hit; -1 as soon as they cannot be more than `most`."""
    hits, left = 0, points.shape[0]
    for n in range(points.shape[0]):
        i = np.int64(math.floor((points[n, 0] + p[0]) * inverse))
        j = np.int64(math.floor((points[n, 1] + p[1]) * inverse))
        k = np.int64(math.floor((points[n, 2] + p[2]) * inverse))
        key = pack(i, j, k)
        hits += keys[slot_of(keys, key)] == key
        left -= 1
        if hits + left <= most:
            return -1
    return hits
