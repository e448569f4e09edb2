"""The tree of RRT* in flat arrays: nearest neighbours, insertion, re-hanging. Lengths in cells.

nodes (C, 4) float: x, y, z, cost from the root. links (C, 4) int: parent, first child, next
sibling, next node of the same bucket; -1: none. head (I, J, K) int: first node of each bucket.
"""

from __future__ import annotations

import math

from numba import njit

COST = 3  # column of nodes
PARENT, CHILD, SIBLING, AFTER = range(4)  # columns of links
NEVER = 1e30


@njit(cache=True, nogil=True)
def gap(a, m, b, n):  # type: ignore[no-untyped-def]
    """Distance of a[m] and b[n]."""
    return math.sqrt((a[m, 0] - b[n, 0]) ** 2 + (a[m, 1] - b[n, 1]) ** 2 + (a[m, 2] - b[n, 2]) ** 2)


@njit(cache=True, nogil=True)
def way_length(points, count):  # type: ignore[no-untyped-def]
    """Length of the polyline points[:count]."""
    total = 0.0
    for n in range(1, count):
        total += gap(points, n, points, n - 1)
    return total


@njit(cache=True, nogil=True)
def drop_repeats(points, count):  # type: ignore[no-untyped-def]
    """Leave out points[:count] that repeat the one before, in place; returns how many are left."""
    kept = min(count, 1)
    for n in range(1, count):
        if gap(points, n, points, n - 1) > 1e-6:
            for k in range(3):
                points[kept, k] = points[n, k]
            kept += 1
    return kept


@njit(cache=True, nogil=True)
def add(nodes, links, head, node, before, bucket):  # type: ignore[no-untyped-def]
    """Node `node`, whose position is set, becomes a child of `before` (-1: a root)."""
    links[node, PARENT], links[node, CHILD], nodes[node, COST] = -1, -1, 0.0
    if before >= 0:
        hang(links, node, before)
        nodes[node, COST] = nodes[before, COST] + gap(nodes, node, nodes, before)
    i, j, k = int(nodes[node, 0] / bucket), int(nodes[node, 1] / bucket), int(nodes[node, 2] / bucket)
    links[node, AFTER] = head[i, j, k]
    head[i, j, k] = node


@njit(cache=True, nogil=True)
def hang(links, node, before):  # type: ignore[no-untyped-def]
    """Make `before` the parent of `node`."""
    old = links[node, PARENT]
    if old >= 0:
        q = links[old, CHILD]
        if q == node:
            links[old, CHILD] = links[node, SIBLING]
        else:
            while links[q, SIBLING] != node:
                q = links[q, SIBLING]
            links[q, SIBLING] = links[node, SIBLING]
    links[node, PARENT], links[node, SIBLING] = before, links[before, CHILD]
    links[before, CHILD] = node


@njit(cache=True, nogil=True)
def nearest(nodes, links, head, x, bucket):  # type: ignore[no-untyped-def]
    """Node nearest to x[0] (1, 3): rings of buckets outwards until none can be nearer."""
    c0, c1, c2 = int(x[0, 0] / bucket), int(x[0, 1] / bucket), int(x[0, 2] / bucket)
    best, best_gap = -1, NEVER
    for ring in range(max(head.shape[0], head.shape[1], head.shape[2])):
        if (ring - 1) * bucket > best_gap:
            break
        for i in range(max(c0 - ring, 0), min(c0 + ring + 1, head.shape[0])):
            for j in range(max(c1 - ring, 0), min(c1 + ring + 1, head.shape[1])):
                whole = abs(i - c0) == ring or abs(j - c1) == ring
                for k in range(max(c2 - ring, 0), min(c2 + ring + 1, head.shape[2])):
                    q = head[i, j, k] if whole or abs(k - c2) == ring else -1
                    while q >= 0:
                        here = gap(nodes, q, x, 0)
                        if here < best_gap:
                            best, best_gap = q, here
                        q = links[q, AFTER]
    return best


@njit(cache=True, nogil=True)
def nearest_of(nodes, count, x):  # type: ignore[no-untyped-def]
    """Node nearest to x[0] (1, 3) among the first `count`: faster than `nearest` while the tree is small."""
    best, best2 = -1, NEVER
    for n in range(count):
        here2 = (nodes[n, 0] - x[0, 0]) ** 2 + (nodes[n, 1] - x[0, 1]) ** 2 + (nodes[n, 2] - x[0, 2]) ** 2
        if here2 < best2:
            best, best2 = n, here2
    return best


@njit(cache=True, nogil=True)
def way_to(nodes, links, node, out):  # type: ignore[no-untyped-def]
    """Write the path root..node into `out` (M, 3); returns its number of points (0: too long)."""
    count, q = 0, node
    while q >= 0:
        count += 1
        q = links[q, PARENT]
    if count > out.shape[0]:
        return 0
    q, n = node, count
    while q >= 0:
        n -= 1
        for k in range(3):
            out[n, k] = nodes[q, k]
        q = links[q, PARENT]
    return count
