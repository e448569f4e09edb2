"""Kernels of roadmaps: which edges are free, and A* along them. Free checks are in cells, the search in m."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from companion.planning.grid import segment_free
from companion.planning.lattice.open_list import BUCKET, PER_CELL, empty_list, pop, push, with_room

_RAISE = 8.0  # units of the open list in the longest edge, so that no raise leaves its ring
_SAME = 1e-9


@njit(cache=True, nogil=True)
def pairs_free(steps, cells, pairs):  # type: ignore[no-untyped-def]
    """Which of the pairs (E, 2) of cells (N, 3) see each other, (E,)."""
    answer = np.empty(len(pairs), np.bool_)
    for n in range(len(pairs)):
        answer[n] = segment_free(steps, cells[pairs[n, 0]], cells[pairs[n, 1]])
    return answer


@njit(cache=True, nogil=True)
def links_free(steps, end, cells):  # type: ignore[no-untyped-def]
    """Which of the cells (N, 3) see `end` (3,), (N,)."""
    answer = np.empty(len(cells), np.bool_)
    for n in range(len(cells)):
        answer[n] = segment_free(steps, end, cells[n])
    return answer


@njit(cache=True, nogil=True)
def route(points, first, after, usable, from_start, to_goal, goal):  # type: ignore[no-untyped-def]
    """Cost, parents (N,), last place before the goal, expansions. Without a way: the reached place nearest to it.

    `from_start`, `to_goal` (N,): length of the link to start and goal, infinite if there is none; `usable` (E,).
    """
    count = len(points)
    cost, parent, closed = from_start.copy(), np.full(count, -1, np.int64), np.zeros(count, np.bool_)
    unit = _unit(points, first, after, from_start)
    heads, pool, state = empty_list()
    pool = with_room(pool, state, count)
    state[BUCKET] = 2**62
    for n in range(count):
        if cost[n] < math.inf:
            state[BUCKET] = min(state[BUCKET], int((cost[n] + _gap(points[n], goal)) / unit * PER_CELL))
    for n in range(count):
        if cost[n] < math.inf:
            push(heads, pool, state, n, (cost[n] + _gap(points[n], goal)) / unit)
    best, last, nearest, near_gap, expanded = math.inf, -1, -1, math.inf, 0
    while True:
        v = pop(heads, pool, state, best / unit)
        if v < 0:
            return best, parent, last if last >= 0 else nearest, expanded
        left = _gap(points[v], goal)
        if closed[v] or cost[v] + left >= best:
            continue
        closed[v] = True
        expanded += 1
        if left < near_gap:
            nearest, near_gap = v, left
        if cost[v] + to_goal[v] < best:
            best, last = cost[v] + to_goal[v], v
        pool = with_room(pool, state, first[v + 1] - first[v])
        for e in range(first[v], first[v + 1]):
            u = after[e]
            way = cost[v] + _gap(points[v], points[u])
            if usable[e] and way < cost[u] - _SAME:
                cost[u], parent[u], closed[u] = way, v, False
                push(heads, pool, state, u, (way + _gap(points[u], goal)) / unit)


@njit(cache=True, nogil=True)
def way_back(parent, last):  # type: ignore[no-untyped-def]
    """The places (K,) from the start's to `last`; none if that is -1."""
    count, v = 0, last
    while v >= 0:
        count += 1
        v = parent[v]
    nodes, v = np.empty(count, np.int64), last
    for n in range(count - 1, -1, -1):
        nodes[n] = v
        v = parent[v]
    return nodes


@njit(cache=True, nogil=True)
def _unit(points, first, after, from_start):  # type: ignore[no-untyped-def]
    """Metres of a unit of the open list."""
    longest = 1e-6
    for v in range(len(points)):
        if from_start[v] < math.inf:
            longest = max(longest, from_start[v])
        for e in range(first[v], first[v + 1]):
            longest = max(longest, _gap(points[v], points[after[e]]))
    return longest / _RAISE


@njit(cache=True, nogil=True)
def _gap(p, q):  # type: ignore[no-untyped-def]
    return math.sqrt((p[0] - q[0]) ** 2 + (p[1] - q[1]) ** 2 + (p[2] - q[2]) ** 2)
