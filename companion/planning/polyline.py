"""Polylines (N, 3): arc length, resampling, projection."""

from __future__ import annotations

import math

import numpy as np

from companion.core.messages import Array


def arc_length(path: Array) -> Array:
    """Length from the start to each vertex, m, (N,)."""
    steps = np.linalg.norm(np.diff(path, axis=0), axis=1)
    return np.concatenate([[0.0], np.cumsum(steps)])


def length(path: Array) -> float:
    """Whole length, m; 0 for fewer than two vertices."""
    return float(arc_length(path)[-1]) if len(path) else 0.0


def at(path: Array, s: Array | float) -> Array:
    """Points at arc lengths `s`, clamped to the ends."""
    along = arc_length(path)
    return np.stack([np.interp(s, along, path[:, k]) for k in range(3)], axis=-1)


def resample(path: Array, spacing_m: float) -> Array:
    """The same way in equal steps of about `spacing_m`; both ends stay. At least two points."""
    total = length(path)
    count = max(1, math.ceil(total / spacing_m - 1e-9))
    return at(path, np.linspace(0.0, total, count + 1))


def cut(path: Array, s_from: float, s_to: float) -> Array:
    """The stretch between two arc lengths, with all vertices inside."""
    along = arc_length(path)
    inner = path[(along > s_from + 1e-9) & (along < s_to - 1e-9)]
    ends = at(path, np.array([s_from, s_to]))
    return np.vstack([ends[:1], inner, ends[1:]])


def project(path: Array, point: Array) -> tuple[float, float]:
    """(arc length, distance) of the nearest point of the path, m."""
    if len(path) < 2:
        return 0.0, float(np.linalg.norm(path[0] - point))
    start, way = path[:-1], np.diff(path, axis=0)
    squared = np.maximum(np.sum(way * way, axis=1), 1e-18)
    part = np.clip(np.sum((point - start) * way, axis=1) / squared, 0.0, 1.0)
    gap = np.linalg.norm(start + part[:, None] * way - point, axis=1)
    k = int(np.argmin(gap))
    return float(arc_length(path)[k] + part[k] * math.sqrt(squared[k])), float(gap[k])


def without_repeats(path: Array) -> Array:
    """Drop vertices that repeat the one before."""
    if len(path) < 2:
        return path
    keep = np.concatenate([[True], np.linalg.norm(np.diff(path, axis=0), axis=1) > 1e-6])
    kept: Array = path[keep]
    return kept
