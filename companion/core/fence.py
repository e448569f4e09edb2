"""The geofence: a polygon and a height band in the home frame. The mission's goals are checked
against it at load, the vehicle in flight."""

from __future__ import annotations

from typing import Annotated

import msgspec
import numpy as np

from companion.core.messages import Array

Metre = Annotated[float, msgspec.Meta(ge=-5000, le=5000, extra={"unit": "m"})]


class Fence(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Where the vehicle may be, home frame (x, y, z from where it armed)."""

    inside: Annotated[tuple[tuple[Metre, Metre], ...], msgspec.Meta(min_length=3)]
    """Corners of the polygon, m."""
    alt: tuple[Metre, Metre]
    """Lowest and highest height above home, m."""

    def depth_m(self, p_home: Array) -> float:
        """How far inside a point (3,) is: distance to the nearest wall, floor or ceiling; < 0 outside."""
        across = edge_distance_m(self.inside, p_home[:2])
        wall = across if contains(self.inside, p_home[:2]) else -across
        return min(wall, float(p_home[2]) - self.alt[0], self.alt[1] - float(p_home[2]))


def contains(polygon: tuple[tuple[float, float], ...], p: Array) -> bool:
    """Even-odd rule; polygon (N, 2), p (2,)."""
    corner, following = np.asarray(polygon), np.roll(np.asarray(polygon), -1, axis=0)
    spans = (corner[:, 1] > p[1]) != (following[:, 1] > p[1])
    rise = np.where(spans, following[:, 1] - corner[:, 1], 1.0)
    x = corner[:, 0] + (p[1] - corner[:, 1]) / rise * (following[:, 0] - corner[:, 0])
    return bool(np.count_nonzero(spans & (p[0] < x)) % 2)


def edge_distance_m(polygon: tuple[tuple[float, float], ...], p: Array) -> float:
    """Distance from p (2,) to the nearest edge of the closed polygon (N, 2), m."""
    a = np.asarray(polygon)
    way = np.roll(a, -1, axis=0) - a
    along = np.sum((p - a) * way, axis=1) / np.maximum(np.sum(way * way, axis=1), 1e-12)
    nearest = a + np.clip(along, 0.0, 1.0)[:, None] * way
    return float(np.min(np.hypot(*(p - nearest).T)))


def crossing_edges(polygon: tuple[tuple[float, float], ...]) -> tuple[int, int] | None:
    """The first two edges (by the index of their first corner) that cross; None: a simple polygon."""
    a = np.asarray(polygon)
    b = np.roll(a, -1, axis=0)
    for i in range(len(a)):
        for j in range(i + 2, len(a)):
            neighbours = i == 0 and j == len(a) - 1
            if not neighbours and _segments_cross(a[i], b[i], a[j], b[j]):
                return i, j
    return None


def area_m2(polygon: tuple[tuple[float, float], ...]) -> float:
    """Area of a simple polygon, m2 (shoelace)."""
    x, y = np.asarray(polygon).T
    return 0.5 * abs(float(x @ np.roll(y, -1) - y @ np.roll(x, -1)))


def _segments_cross(a: Array, b: Array, c: Array, d: Array) -> bool:
    def side(p: Array, q: Array, r: Array) -> float:
        return float((q[0] - p[0]) * (r[1] - p[1]) - (q[1] - p[1]) * (r[0] - p[0]))

    return side(a, b, c) * side(a, b, d) <= 0 and side(c, d, a) * side(c, d, b) <= 0 and _overlap(a, b, c, d)


def _overlap(a: Array, b: Array, c: Array, d: Array) -> bool:
    """Bounding boxes meet (decides collinear segments)."""
    low = np.maximum(np.minimum(a, b), np.minimum(c, d))
    high = np.minimum(np.maximum(a, b), np.maximum(c, d))
    return bool(np.all(low <= high))
