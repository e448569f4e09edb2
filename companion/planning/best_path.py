"""The best path of a tree of RRT*: what is free is shortened, hung into the tree, and kept if it is better.

One call does it all: a first way takes some ten microseconds of work, as much as a few calls from Python cost.
`tree` is (nodes, links, head, counts, bucket), see `tree` and `grow`; `kept` is (best, path): the best path so far, and
scratch, (M, 3) each, in cells.
"""

from __future__ import annotations

from numba import njit

from companion.planning.grow import BEST, GOAL, NODES, add_chain
from companion.planning.shortcut import shorten
from companion.planning.tree import COST, way_length, way_to

_BETTER = 1e-9  # cells


@njit(cache=True, nogil=True)
def keep(tree, kept, cost):  # type: ignore[no-untyped-def]
    """Write the tree's way to the goal to `best` if it is shorter than `cost`; returns the cost of the best."""
    (nodes, links, _, counts, _), (best, path) = tree, kept
    if not (nodes[GOAL, COST] < cost - _BETTER and counts[NODES] > 2):
        return cost
    count = way_to(nodes, links, GOAL, path)
    if count == 0:
        return cost
    for n in range(count):
        for k in range(3):
            best[n, k] = path[n, k]
    counts[BEST] = count
    return way_length(best, count)


@njit(cache=True, nogil=True)
def take(tree, kept, count, cost):  # type: ignore[no-untyped-def]
    """Hang path[:count], which is free and begins at the start, into the tree; then `keep`."""
    (nodes, links, head, counts, bucket), (_, path) = tree, kept
    add_chain(nodes, links, head, counts, bucket, path[:count])
    return keep(tree, kept, cost)


@njit(cache=True, nogil=True)
def better(steps, tree, kept, count, draws, cost):  # type: ignore[no-untyped-def]
    """Shorten path[:count], one attempt per row of `draws`; then `take` it if it is shorter than `cost`."""
    path = kept[1]
    count = shorten(steps, path, count, draws)
    return take(tree, kept, count, cost) if way_length(path, count) < cost - _BETTER else cost
