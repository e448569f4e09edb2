"""Whatever is neither ground nor tree: racks, halls, rock, as triangles that are hit and touched.

Distance of a point to a triangle: C. Ericson, "Real-Time Collision Detection", 2005, sec. 5.1.5; a ray:
T. Moeller and B. Trumbore, "Fast, Minimum Storage Ray/Triangle Intersection", 1997.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from companion.core.messages import Array
from sim.world.columns import columns_crossed, sort_into_columns

_FREE_M = 1e-9  # a ray that starts on a wall leaves it
Tables = tuple[Array, Array, Array, NDArray[np.int64], NDArray[np.int64]]


@dataclass(frozen=True, eq=False)
class Walls:
    """Triangles (T, 3, 3), m, world; each with the ball about its middle; those of cell (i, j) as in `Columns`."""

    corners: Array
    balls: Array  # (T, 4), middle and radius
    frame: Array  # (4,): corner of the columns x, y, and how many there are in x, y
    start: NDArray[np.int64]  # (nx * ny + 1,)
    items: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.corners)

    def tables(self) -> Tables:
        """Copies for the kernels: a read-only array would be one more type to compile for."""
        return self.corners.copy(), self.balls.copy(), self.frame.copy(), self.start.copy(), self.items.copy()

    def first_hit(self, p_world: Array, direction: Array, max_range_m: float) -> float:
        """Distance along a unit direction to the first wall within the range; inf: none."""
        if not len(self):
            return math.inf
        p, d = np.asarray(p_world, np.float64), np.asarray(direction, np.float64)
        if not (np.all(np.isfinite(p)) and np.all(np.isfinite(d))):
            return math.inf
        hit = float(_first_hit(self.corners, self.frame, self.start, self.items, p, d, max_range_m))
        return hit if hit < max_range_m else math.inf


def make_walls(corners: Array) -> Walls:
    """Sort triangles (T, 3, 3) into columns."""
    corners = np.ascontiguousarray(corners, np.float64).reshape(-1, 3, 3)
    middle = corners.mean(axis=1)
    radius = np.linalg.norm(corners - middle[:, None], axis=2).max(axis=1)
    columns = sort_into_columns(corners[..., :2].min(axis=1), corners[..., :2].max(axis=1))
    return Walls(corners, np.column_stack([middle, radius]), columns.frame, columns.start, columns.items)


NO_WALLS = make_walls(np.zeros((0, 3, 3)))


@njit(cache=True, nogil=True)
def _first_hit(corners, frame, start, items, p, d, reach):  # type: ignore[no-untyped-def]
    columns, entered = columns_crossed(frame, p, d, reach)
    best = reach
    for n in range(columns.size):
        if entered[n] >= best:
            break
        for q in range(start[columns[n]], start[columns[n] + 1]):
            best = min(best, _ray(corners[items[q]], p, d))
    return best


@njit(cache=True, nogil=True)
def _ray(c, p, d):  # type: ignore[no-untyped-def]
    """Distance to a triangle (3, 3) from either side; inf: missed."""
    e1, e2 = c[1] - c[0], c[2] - c[0]
    h0, h1, h2 = d[1] * e2[2] - d[2] * e2[1], d[2] * e2[0] - d[0] * e2[2], d[0] * e2[1] - d[1] * e2[0]
    det = e1[0] * h0 + e1[1] * h1 + e1[2] * h2
    if abs(det) < 1e-15:
        return np.inf
    s = p - c[0]
    u = (s[0] * h0 + s[1] * h1 + s[2] * h2) / det
    q0, q1, q2 = s[1] * e1[2] - s[2] * e1[1], s[2] * e1[0] - s[0] * e1[2], s[0] * e1[1] - s[1] * e1[0]
    v = (d[0] * q0 + d[1] * q1 + d[2] * q2) / det
    t = (e2[0] * q0 + e2[1] * q1 + e2[2] * q2) / det
    return t if u >= 0.0 and v >= 0.0 and u + v <= 1.0 and t > _FREE_M else np.inf


@njit(cache=True, nogil=True)
def point_to_triangle(c, px, py, pz):  # type: ignore[no-untyped-def]
    """Distance of a point to a triangle (3, 3), m, by the Voronoi region of the triangle that it lies in."""
    ab = (c[1, 0] - c[0, 0], c[1, 1] - c[0, 1], c[1, 2] - c[0, 2])
    ac = (c[2, 0] - c[0, 0], c[2, 1] - c[0, 1], c[2, 2] - c[0, 2])
    ap = (px - c[0, 0], py - c[0, 1], pz - c[0, 2])
    bp = (px - c[1, 0], py - c[1, 1], pz - c[1, 2])
    cp = (px - c[2, 0], py - c[2, 1], pz - c[2, 2])
    v, w = _nearest(_dot(ab, ap), _dot(ac, ap), _dot(ab, bp), _dot(ac, bp), _dot(ab, cp), _dot(ac, cp))
    x, y, z = (ap[0] - v * ab[0] - w * ac[0], ap[1] - v * ab[1] - w * ac[1], ap[2] - v * ab[2] - w * ac[2])
    return math.sqrt(x * x + y * y + z * z)


@njit(cache=True, nogil=True)
def _nearest(d1, d2, d3, d4, d5, d6):  # type: ignore[no-untyped-def]
    """Coordinates along the two sides of the nearest point; names as in the source."""
    va, vb, vc = d3 * d6 - d5 * d4, d5 * d2 - d1 * d6, d1 * d4 - d3 * d2
    if d1 <= 0.0 and d2 <= 0.0:
        return 0.0, 0.0
    if d3 >= 0.0 and d4 <= d3:
        return 1.0, 0.0
    if d6 >= 0.0 and d5 <= d6:
        return 0.0, 1.0
    if vc <= 0.0 and d1 >= 0.0 and d3 <= 0.0:
        return d1 / (d1 - d3), 0.0
    if vb <= 0.0 and d2 >= 0.0 and d6 <= 0.0:
        return 0.0, d2 / (d2 - d6)
    if va <= 0.0 and d4 - d3 >= 0.0 and d5 - d6 >= 0.0:
        w = (d4 - d3) / (d4 - d3 + d5 - d6)
        return 1.0 - w, w
    return vb / (va + vb + vc), vc / (va + vb + vc)


@njit(cache=True, nogil=True)
def _dot(a, b):  # type: ignore[no-untyped-def]
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
