"""What the shape of a path allows: speeds at which its bends and climbs keep within the limits."""

from __future__ import annotations

import math

import numpy as np

from companion.core.messages import Array, Limits

_BEND_POINTS = 3  # derivatives are taken over so many points to each side
_LEVEL = 0.3  # of the direction must be horizontal for the nose to follow it


def spacing_of(points: Array) -> float:
    """Distance between the first two of evenly spaced points, m."""
    return float(np.linalg.norm(points[1] - points[0])) if len(points) > 1 else 0.0


def curvature(points: Array) -> Array:
    """1/m (N,) at evenly spaced points, over a few points to both sides."""
    bend = np.zeros(len(points))
    m = min(_BEND_POINTS, (len(points) - 1) // 2)
    if m == 0:
        return bend
    before, after = points[m:-m] - points[: -2 * m], points[2 * m :] - points[m:-m]
    lengths = np.linalg.norm(before, axis=1), np.linalg.norm(after, axis=1)
    turn = after / np.maximum(lengths[1], 1e-9)[:, None] - before / np.maximum(lengths[0], 1e-9)[:, None]
    bend[m:-m] = np.linalg.norm(turn, axis=1) / np.maximum(0.5 * (lengths[0] + lengths[1]), 1e-9)
    return bend


def bending(points: Array) -> Array:
    """|d3r/ds3|, 1/m2, (N,) at evenly spaced points: how fast the curvature vector changes."""
    out, step = np.zeros(len(points)), spacing_of(points)
    m = min(_BEND_POINTS, (len(points) - 1) // 3)
    if m == 0 or step <= 0.0:
        return out
    r, begin = points, (3 * m) // 2
    third = np.linalg.norm(r[3 * m :] - 3.0 * r[2 * m : -m] + 3.0 * r[m : -2 * m] - r[: -3 * m], axis=1)
    out[begin : begin + len(third)] = third / (m * step) ** 3
    return out


def heading_rate(points: Array) -> Array:
    """Turn of the heading per metre, rad/m, (N,); 0 where the way is too steep to have one."""
    step = max(spacing_of(points), 1e-9)
    way = np.gradient(points, step, axis=0)
    turn = np.gradient(way, step, axis=0)
    level = way[:, 0] ** 2 + way[:, 1] ** 2
    across = np.abs(way[:, 0] * turn[:, 1] - way[:, 1] * turn[:, 0])
    rate: Array = np.where(level > _LEVEL**2, across / np.maximum(level, _LEVEL**2), 0.0)
    return rate


def by_shape(points: Array, limits: Limits, *, along: float, across: tuple[float, float]) -> Array:
    """Speeds (N,), m/s, within speed, climb, yaw rate, and `across` = (acceleration m/s2, jerk m/s3) of bends.

    `along` (m/s2) is the acceleration that may go with them. An infinite yaw rate: the nose does not follow the way.
    """
    if len(points) < 3:
        return np.full(len(points), min(limits.speed, limits.climb))
    way, bend = np.gradient(points, axis=0), curvature(points)
    steep = np.abs(way[:, 2]) / np.maximum(np.linalg.norm(way, axis=1), 1e-9)
    curve = np.sqrt(across[0] / np.maximum(bend, 1e-6))
    climb = limits.climb / np.maximum(steep, 1e-6)
    turn = limits.yaw_rate / np.maximum(heading_rate(points), 1e-9)
    ease = _by_bending(bending(points), 3.0 * along * bend, across[1], limits.speed)
    speeds: Array = np.min([curve, climb, turn, ease, np.full(len(points), limits.speed)], axis=0)
    return speeds


def _by_bending(third: Array, first: Array, jerk: float, top_m_s: float) -> Array:
    """v (N,) at which v^3 |r'''| + 3 v a |r''|, the jerk but for that along the way, is `jerk`; at most the top speed.

    By Newton's method from above: the function is convex and rises, so it never falls below the root.
    """
    v = np.full(len(third), top_m_s)
    if not math.isfinite(jerk):
        return v
    for _ in range(12):
        excess = np.maximum(third * v**3 + first * v - jerk, 0.0)
        v = v - excess / np.maximum(3.0 * third * v**2 + first, 1e-9)
    return v
