"""Theta* (Daniel, Nash, Koenig and Felner 2010): A* on a grid whose ways may go straight between any cells in sight.

Each node hangs on the farthest ancestor of the node before it that sees it: one look back, not the optimum.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from companion.planning.grid import segment_free
from companion.planning.lattice.open_list import BUCKET, PER_CELL, ROOM, empty_list, pop, push, with_room
from companion.planning.lattice.search import CLOSED, NEVER, SAME, surroundings, unflat, with_space

SEEN = 1


@njit(cache=True, nogil=True)
def theta_star(blocked, shape, moves, ends, places, steps, label, cost, parent):  # type: ignore[no-untyped-def]
    """Number of expansions, and every node seen; arrays as in `search`.

    `places` (2, 3): where in their cells the way begins and ends; `steps` of the space, for the line of sight.
    `parent` (V,): scratch; leads from the goal to the start if the goal is labelled CLOSED.
    """
    start, goal = ends
    heads, pool, state = empty_list()
    seen, count, expanded, points = np.empty(4096, np.int32), 1, 0, np.empty((3, 3))
    seen[0], cost[start], label[start], parent[start] = start, 0.0, SEEN, start
    f = _gap(places[0], places[1])
    state[BUCKET] = int(f * PER_CELL)
    push(heads, pool, state, start, f)
    while True:
        v = pop(heads, pool, state, NEVER)
        if v < 0:
            return expanded, seen[:count]
        if label[v] & CLOSED:
            continue
        label[v] |= CLOSED
        if v == goal:
            return expanded, seen[:count]
        expanded += 1
        pool = with_room(pool, state, ROOM)
        seen = with_space(seen, count)
        walls = surroundings(blocked, v, shape)
        _put(parent[v], shape, ends, places, points[0])
        _put(v, shape, ends, places, points[1])
        for m in range(len(moves[0])):
            u = v + moves[0][m]
            if walls & moves[3][m] or label[u] & CLOSED:
                continue
            _put(u, shape, ends, places, points[2])
            before = NEVER if label[u] == 0 else cost[u]
            if _hang(v, u, points, before, steps, cost, parent):
                if label[u] == 0:
                    seen[count] = u
                    count += 1
                label[u] = SEEN
                push(heads, pool, state, u, cost[u] + _gap(points[2], places[1]))


@njit(cache=True, nogil=True)
def _hang(v, u, points, before, steps, cost, parent):  # type: ignore[no-untyped-def]
    """Hang `u` on the parent of `v` if that sees it, else on `v`, if it gets cheaper than `before`.

    points (3, 3): the parent's, v's, u's.
    """
    far = cost[parent[v]] + _gap(points[0], points[2])
    if far >= before - SAME:
        return False  # and by the triangle inequality the way through v is no shorter
    if segment_free(steps, points[0], points[2]):
        parent[u], cost[u] = parent[v], far
        return True
    near = cost[v] + _gap(points[1], points[2])
    if near >= before - SAME:
        return False
    parent[u], cost[u] = v, near
    return True


@njit(cache=True, nogil=True)
def chain(parent, ends):  # type: ignore[no-untyped-def]
    """The nodes (N,) from start to goal, parent by parent."""
    count, v = 1, ends[1]
    while v != ends[0]:
        v = parent[v]
        count += 1
    nodes, v = np.empty(count, np.int64), ends[1]
    for n in range(count - 1, -1, -1):
        nodes[n] = v
        v = parent[v]
    return nodes


@njit(cache=True, nogil=True)
def _put(v, shape, ends, places, point):  # type: ignore[no-untyped-def]
    """Where the way passes through a cell: its centre, but for the ends; in cells of the grid without rim."""
    if v == ends[0] or v == ends[1]:
        end = 0 if v == ends[0] else 1
        for a in range(3):
            point[a] = places[end, a]
        return
    i, j, k = unflat(v, shape)
    point[0], point[1], point[2] = i - 0.5, j - 0.5, k - 0.5


@njit(cache=True, nogil=True)
def _gap(p, q):  # type: ignore[no-untyped-def]
    return math.sqrt((p[0] - q[0]) ** 2 + (p[1] - q[1]) ** 2 + (p[2] - q[2]) ** 2)
