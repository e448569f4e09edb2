"""Which points of a scan the map of a moment ago did not expect, and which of them belong together.

A point in the midst of space that was seen free is where something has come to. The map must be
older than the thing's stay there, else the thing is in it: what turns round comes back to where it was
a moment ago, so beside what is believed to move a still older map is asked, too.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import msgspec
import numpy as np
from numba import njit
from numpy.typing import NDArray

from companion.core.messages import Array, Array32

Positive = Annotated[float, msgspec.Meta(gt=0)]
_FREE = 1


class ClusterConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """What counts as one thing."""

    range_m: Positive = 15.0  # of points looked at
    join_m: Positive = 0.5  # points nearer than this are of one thing
    min_points: Annotated[int, msgspec.Meta(ge=1)] = 6
    max_points: Annotated[int, msgspec.Meta(ge=10, le=2000)] = (
        400  # of a scan that are clustered: the first, evenly thinned
    )
    max_width_m: Positive = 1.6  # in plan; what is wider is no single thing


@dataclass(frozen=True, slots=True)
class Background:
    """States of a local map (0 unknown, 1 free, 2 occupied), (X, Y, Z), from `origin_odom` on."""

    stamp_ns: int
    origin_odom: Array  # (3,), m
    resolution_m: float
    state: NDArray[np.uint8]


@dataclass(frozen=True, slots=True)
class Clusters:
    """Things seen, ordered by their first point."""

    centre_odom: Array  # (N, 3), m
    radius_m: Array  # half the widest extent in plan, (N,)
    points: NDArray[np.int64]  # (N,)


def unexpected(points_body: Array32, R: Array, p: Array, known: Background, config: ClusterConfig) -> Array:
    """Points (M, 3) in odom of a scan (N, 3) at the pose (R, p) whose cell and its 26 neighbours were all free."""
    found = np.empty((len(points_body), 3))
    place = (known.origin_odom, 1.0 / known.resolution_m)
    count = _unexpected(points_body, np.ascontiguousarray(R), p, known.state, place, config.range_m**2, found)
    return found[:count]


def beside(points_odom: Array, places_odom: Array, within_m: float) -> Array:
    """Those of the points (N, 3) that are, in plan, within a distance of one of the places (K, 3), (M, 3)."""
    gap = np.linalg.norm((points_odom[:, None] - places_odom[None])[:, :, :2], axis=2)
    near: Array = points_odom[(gap <= within_m).any(axis=1)]
    return near


def joined(first: Array, second: Array) -> Array:
    """Points (N, 3) of both, each once, those of the first before the others."""
    both = np.concatenate([first, second])
    _, at = np.unique(both, axis=0, return_index=True)
    return both[np.sort(at)]


def clusters(points_odom: Array, config: ClusterConfig) -> Clusters:
    """Points (M, 3) joined into things; those too small or too wide are left out."""
    points = np.ascontiguousarray(points_odom[:: max(1, -(-len(points_odom) // config.max_points))])
    if len(points) < config.min_points:
        return Clusters(np.empty((0, 3)), np.empty(0), np.empty(0, np.int64))
    label = np.full(len(points), -1, np.int64)
    count = _label(points, config.join_m**2, label)
    sizes = np.bincount(label, minlength=count)
    low, high = np.full((count, 3), np.inf), np.full((count, 3), -np.inf)
    np.minimum.at(low, label, points)
    np.maximum.at(high, label, points)
    width = (high - low)[:, :2].max(axis=1)
    kept = (sizes >= config.min_points) & (width <= config.max_width_m)
    return Clusters(0.5 * (low + high)[kept], 0.5 * width[kept], sizes[kept])


@njit(cache=True, nogil=True)
def _label(points, join2, label):  # type: ignore[no-untyped-def]
    """Connected components, numbered by their first point; returns how many. Few points: every pair is looked at."""
    n = points.shape[0]
    queue = np.empty(n, np.int64)
    count = 0
    for first in range(n):
        if label[first] >= 0:
            continue
        label[first], queue[0], size, head = count, first, 1, 0
        while head < size:
            a = queue[head]
            head += 1
            for b in range(n):
                if label[b] < 0:
                    dx, dy, dz = points[a, 0] - points[b, 0], points[a, 1] - points[b, 1], points[a, 2] - points[b, 2]
                    if dx * dx + dy * dy + dz * dz <= join2:
                        label[b], queue[size] = count, b
                        size += 1
        count += 1
    return count


@njit(cache=True, nogil=True)
def _unexpected(points, R, p, state, place, range2, found):  # type: ignore[no-untyped-def]
    origin, per_m = place
    nx, ny, nz = state.shape
    count = 0
    for n in range(points.shape[0]):
        a, b, c = np.float64(points[n, 0]), np.float64(points[n, 1]), np.float64(points[n, 2])
        if a * a + b * b + c * c > range2:
            continue
        x = R[0, 0] * a + R[0, 1] * b + R[0, 2] * c + p[0]
        y = R[1, 0] * a + R[1, 1] * b + R[1, 2] * c + p[1]
        z = R[2, 0] * a + R[2, 1] * b + R[2, 2] * c + p[2]
        i = np.int64(np.floor((x - origin[0]) * per_m))
        j = np.int64(np.floor((y - origin[1]) * per_m))
        k = np.int64(np.floor((z - origin[2]) * per_m))
        if i < 1 or j < 1 or k < 1 or i + 1 >= nx or j + 1 >= ny or k + 1 >= nz or state[i, j, k] != _FREE:
            continue
        if _all_free(state, i, j, k):
            found[count, 0], found[count, 1], found[count, 2] = x, y, z
            count += 1
    return count


@njit(cache=True, nogil=True)
def _all_free(state, i, j, k):  # type: ignore[no-untyped-def]
    for u in range(i - 1, i + 2):
        for v in range(j - 1, j + 2):
            for w in range(k - 1, k + 2):
                if state[u, v, w] != _FREE:
                    return False
    return True
