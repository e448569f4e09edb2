"""Take a path past obstacles on their other side where that is shorter. Lengths in cells.

Shortcuts leave a path on the side of each trunk on which it was found; there are two to the power of the trunks on the
way of such sides. So the way across the chord of each bend is tried, out to where a detour would be no shorter.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from companion.planning.grid import segment_free
from companion.planning.tree import gap

DRAWS = 6  # uniforms per attempt
_WORTH = 0.02  # less is not worth a point


@njit(cache=True, nogil=True)
def detour(steps, path, count, draws, reach):  # type: ignore[no-untyped-def]
    """Works in place on path[:count], one attempt per row of `draws`; returns the new count.

    A bend is cut off up to `reach` to either side. Every change keeps the path free and makes it shorter.
    """
    cut = np.empty((4, 3))  # before, tip, after; and the direction across
    for row in range(draws.shape[0]):
        if count < 3 or count + 3 > path.shape[0]:
            return count
        u = draws[row]
        v = 1 + min(int(u[0] * (count - 2)), count - 3)
        first = _go(path, v, -1, 0, reach * u[1], cut[0])
        last = _go(path, v, 1, count - 1, reach * u[2], cut[2])
        old = gap(cut, 0, path, first) + gap(path, last, cut, 2)
        for n in range(first, last):
            old += gap(path, n, path, n + 1)
        if gap(cut, 0, cut, 2) < old - _WORTH and _across(path[v], cut, u) and _tip(steps, cut, old):
            count = _put(path, count, first, last, cut)
    return count


@njit(cache=True, nogil=True)
def _go(path, v, way, end, far, place):  # type: ignore[no-untyped-def]
    """The place `far` along the path from vertex v, at most the end; returns the last vertex before it."""
    while v != end:
        edge = gap(path, v, path, v + way)
        if edge >= far:
            share = far / max(edge, 1e-9)
            for k in range(3):
                place[k] = path[v, k] + share * (path[v + way, k] - path[v, k])
            return v
        far -= edge
        v += way
    place[:] = path[v]
    return v - way


@njit(cache=True, nogil=True)
def _across(bend, cut, u):  # type: ignore[no-untyped-def]
    """Foot of the bend on the chord into cut[1], and a unit vector from the bend across it, about, into cut[3]."""
    chord = gap(cut, 0, cut, 2)
    if chord < 1.0:
        return False
    along = 0.0
    for k in range(3):
        along += (bend[k] - cut[0, k]) * (cut[2, k] - cut[0, k]) / chord
    along = min(max(along, 0.2 * chord), 0.8 * chord)
    for k in range(3):
        cut[1, k] = cut[0, k] + along / chord * (cut[2, k] - cut[0, k])
        cut[3, k] = cut[1, k] - bend[k]
    size = math.sqrt(cut[3, 0] ** 2 + cut[3, 1] ** 2 + cut[3, 2] ** 2)
    slip = 0.0
    for k in range(3):
        cut[3, k] += (u[3 + k] - 0.5) * max(size, 0.5)
        slip += cut[3, k] * (cut[2, k] - cut[0, k]) / chord
    square = 0.0
    for k in range(3):
        cut[3, k] -= slip * (cut[2, k] - cut[0, k]) / chord
        square += cut[3, k] ** 2
    for k in range(3):
        cut[3, k] /= math.sqrt(max(square, 1e-18))
    return True


@njit(cache=True, nogil=True)
def _tip(steps, cut, old):  # type: ignore[no-untyped-def]
    """Move cut[1] out from the chord until both its edges are free; False: not before they are as long as `old`."""
    while gap(cut, 0, cut, 1) + gap(cut, 1, cut, 2) < old - _WORTH:
        if segment_free(steps, cut[1], cut[0]) and segment_free(steps, cut[1], cut[2]):
            return True
        for k in range(3):
            cut[1, k] += 0.5 * cut[3, k]
    return False


@njit(cache=True, nogil=True)
def _put(path, count, first, last, cut):  # type: ignore[no-untyped-def]
    """Three points in place of path[first : last + 1]; returns the new count."""
    more = 3 - (last + 1 - first)
    if more > 0:
        for n in range(count - 1, last, -1):
            path[n + more] = path[n]
    elif more < 0:
        for n in range(last + 1, count):
            path[n + more] = path[n]
    for n in range(3):
        path[first + n] = cut[n]
    return count + more
