"""Shorten a valid path: greedy shortcuts, cut corners, vertices pulled straight. Lengths in cells."""

from __future__ import annotations

import numpy as np
from numba import njit

from companion.planning.grid import segment_free
from companion.planning.tree import gap

DRAWS = 6  # uniforms per attempt


@njit(cache=True, nogil=True)
def shorten(steps, path, count, draws):  # type: ignore[no-untyped-def]
    """Works in place on path[:count]; one attempt per row of `draws`. Returns the new count.

    Every change keeps the path free and never makes it longer (Geraerts and Overmars 2007).
    """
    count = _greedy(steps, path, count)
    trial = np.empty((2, 3))
    for row in range(draws.shape[0]):
        if count < 3:
            return count
        u = draws[row]
        v = 1 + min(int(u[0] * (count - 2)), count - 3)
        if u[1] < 0.5 and count < path.shape[0] - 1:
            count = _cut_corner(steps, path, count, v, u, trial)
        else:
            _pull_straight(steps, path, v, u, trial)
    return _greedy(steps, path, count)


@njit(cache=True, nogil=True)
def _greedy(steps, path, count):  # type: ignore[no-untyped-def]
    """From each kept vertex go on to the farthest one in sight."""
    kept, i = 1, 0
    while i < count - 1:
        j = count - 1
        while j > i + 1 and not segment_free(steps, path[i], path[j]):
            j -= 1
        for k in range(3):
            path[kept, k] = path[j, k]
        kept += 1
        i = j
    return kept


@njit(cache=True, nogil=True)
def _cut_corner(steps, path, count, v, u, trial):  # type: ignore[no-untyped-def]
    """Replace vertex v by two points on its edges if the straight way between them is free."""
    for k in range(3):
        trial[0, k] = path[v, k] + u[2] * u[2] * (path[v - 1, k] - path[v, k])
        trial[1, k] = path[v, k] + u[3] * u[3] * (path[v + 1, k] - path[v, k])
    saved = gap(trial, 0, path, v) + gap(path, v, trial, 1) - gap(trial, 0, trial, 1)
    if saved < 1e-3 or not segment_free(steps, trial[0], trial[1]):
        return count
    for k in range(3):
        for n in range(count, v + 1, -1):
            path[n, k] = path[n - 1, k]
        path[v, k], path[v + 1, k] = trial[0, k], trial[1, k]
    return count + 1


@njit(cache=True, nogil=True)
def _pull_straight(steps, path, v, u, trial):  # type: ignore[no-untyped-def]
    """Move vertex v towards the straight line of its neighbours, with a random sideways kick."""
    left, right, reach = gap(path, v - 1, path, v), gap(path, v, path, v + 1), u[2] * u[2]
    part = left / max(left + right, 1e-9)
    for k in range(3):
        trial[1, k] = path[v - 1, k] + part * (path[v + 1, k] - path[v - 1, k])
    off = gap(trial, 1, path, v)
    for k in range(3):
        trial[0, k] = path[v, k] + reach * (trial[1, k] - path[v, k] + (u[3 + k] - 0.5) * off)
    if gap(path, v - 1, trial, 0) + gap(trial, 0, path, v + 1) >= left + right:
        return
    if segment_free(steps, path[v - 1], trial[0]) and segment_free(steps, trial[0], path[v + 1]):
        for k in range(3):
            path[v, k] = trial[0, k]
