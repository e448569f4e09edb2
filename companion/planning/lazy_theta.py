"""Lazy Theta* (Nash, Koenig and Tovey 2010) on a lattice that is coarse where obstacles are far.

A node is hung on the parent of the node that found it without looking; when it is expanded, and that parent is not in
sight, it hangs on the best expanded neighbour. The step from the neighbour that found it was always looked at, so
every node has a free way to the start.

>>> search = LazyTheta()
>>> search.begin(space.steps, ends_cells, levels=(2, 3), weight=3.0)
>>> while search.advance(400) == "open": ...
>>> search.path()  # (N, 3), cells
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from numba import njit
from numpy.typing import NDArray

from companion.core.messages import Array
from companion.planning.grid import JUMP_UNIT, segment_free
from companion.planning.heap import pop, push
from companion.planning.tree import COST, NEVER, gap
from companion.planning.wave import FAR

COARSEST = 3  # level n: lattice points 2^n cells apart
State = Literal["open", "found", "exhausted"]
Guide = tuple[NDArray[np.uint16], int, float]
"""Layers of a `Wave` from the goal, (X, Y, Z), cells per block, and what share of them counts: waves are not round."""
NO_GUIDE: Guide = np.zeros((0, 0, 0), np.uint16), 1, 1.0
_PARENT, _VIA, _CELL = range(3)  # columns of links; nodes count from 1, 0: none
_NODES, _LEFT, _LAST = range(3)  # of counts: nodes used, expansions left, node that sees the goal
_OPEN, _FOUND, _EXHAUSTED, _FULL = range(4)
_START, _ROOM = 1, 32  # more than a node has neighbours
_JUMPS = np.array([1.0, 3.0, 4.5]) * JUMP_UNIT  # least free jump around a point of level 1, 2, 3
# Where in its cell a lattice point lies. Off the centre, so that no diagonal step runs exactly through a corner.
_PLACE = np.array([0.511, 0.483, 0.507])


class LazyTheta:
    """One search at a time, in portions of expansions; keeps its memory for the next."""

    def __init__(self) -> None:
        self._index = np.zeros(0, np.int32)  # node of each cell
        self._resize(4096)
        self._counts = np.array([1, 0, 0])
        self._heap = (np.empty(8192), np.empty(8192, np.int32), np.zeros(1, np.int64))

    def _resize(self, nodes: int) -> None:
        self._nodes, self._links = np.zeros((nodes, 4)), np.zeros((nodes, 3), np.int32)
        self._closed = np.zeros(nodes, np.bool_)

    def begin(
        self,
        steps: NDArray[np.uint8],
        ends: Array,
        *,
        levels: tuple[int, int],
        weight: float,
        most: float = NEVER,
        guide: Guide = NO_GUIDE,
    ) -> None:
        """A new search from ends[0] to ends[1], (2, 3) cells, both free.

        `levels` = finest, coarsest (0 to COARSEST) in use. A `weight` above 1 makes the search greedy; only ways
        shorter than `most` cells count. A `guide` that is too long hides ways.
        """
        self._forget(steps.size)
        self._steps, self._ends = steps, np.ascontiguousarray(ends, np.float64)
        self._levels, self._bound, self._guide = levels, (weight, most), guide
        self._heap[2][0] = 0
        plant(steps, self._ends, weight, self._tree, self._heap, self._counts)

    @property
    def _tree(self) -> tuple[NDArray[np.int32], Array, NDArray[np.int32], NDArray[np.bool_]]:
        return self._index, self._nodes, self._links, self._closed

    def _forget(self, cells: int) -> None:
        used = int(self._counts[_NODES])
        if len(self._index) == cells:
            self._index[self._links[1:used, _CELL]] = 0
        else:
            self._index = np.zeros(cells, np.int32)
        self._counts[:] = 1, 0, 0

    def advance(self, expansions: int) -> State:
        """Expand at most so many nodes more."""
        self._counts[_LEFT] = expansions
        while True:
            world = (self._steps, self._ends, self._levels, self._bound, self._guide)
            code = expand(*world, self._tree, self._heap, self._counts)
            if code != _FULL:
                return ("open", "found", "exhausted")[code]
            self._grow()

    def _grow(self) -> None:
        used, (keys, items, size) = int(self._counts[_NODES]), self._heap
        if used + _ROOM > len(self._nodes):
            old = self._nodes, self._links, self._closed
            self._resize(2 * len(self._nodes))
            self._nodes[:used], self._links[:used], self._closed[:used] = (array[:used] for array in old)
        if size[0] + _ROOM > len(keys):
            self._heap = np.resize(keys, 2 * len(keys)), np.resize(items, 2 * len(items)), size

    @property
    def expanded(self) -> int:
        """Nodes closed so far."""
        return int(np.count_nonzero(self._closed[: int(self._counts[_NODES])]))

    def path(self) -> Array:
        """The way found, corners (N, 3) in cells, both ends included."""
        chain, node = [self._ends[1]], int(self._counts[_LAST])
        while node:
            chain.append(self._nodes[node, :3])
            node = int(self._links[node, _PARENT])
        return np.array(chain[::-1])


@njit(cache=True, nogil=True)
def plant(steps, ends, weight, tree, heap, counts):  # type: ignore[no-untyped-def]
    """Make the start the only node, and open."""
    index, nodes, links, closed = tree
    for k in range(3):
        nodes[_START, k] = ends[0, k]
    nodes[_START, COST] = 0.0
    cell = (int(ends[0, 0]) * steps.shape[1] + int(ends[0, 1])) * steps.shape[2] + int(ends[0, 2])
    index[cell] = _START
    links[_START, _PARENT], links[_START, _VIA], links[_START, _CELL] = 0, 0, cell
    closed[_START] = False
    counts[_NODES] = _START + 1
    push(heap[0], heap[1], heap[2], weight * gap(ends, 0, ends, 1), _START)


@njit(cache=True, nogil=True)
def expand(steps, ends, levels, bound, guide, tree, heap, counts):  # type: ignore[no-untyped-def]
    """Expand nodes until the goal is in sight, none is left, memory is full or counts says stop.

    index (V,) node of a cell; nodes (C, 4) x, y, z, cost; links (C, 3); closed (C,); heap as in `heap`.
    """
    _, nodes, _, closed = tree
    keys, items, size = heap
    while counts[_LEFT] > 0:
        if counts[_NODES] + _ROOM > nodes.shape[0] or size[0] + _ROOM > keys.shape[0]:
            return _FULL
        if size[0] == 0:
            return _EXHAUSTED
        v = pop(keys, items, size)
        if closed[v]:
            continue
        level = _level(steps, nodes, v, levels)
        _settle(steps, v, level, tree)
        closed[v] = True
        counts[_LEFT] -= 1
        if nodes[v, COST] + _left(nodes, v, ends, guide) >= bound[1]:
            continue
        if segment_free(steps, nodes[v], ends[1]):
            counts[_LAST] = v
            return _FOUND
        _offer(steps, ends, v, level, bound, guide, tree, heap, counts)
    return _OPEN


@njit(cache=True, nogil=True)
def _left(nodes, v, ends, guide):  # type: ignore[no-untyped-def]
    """About how far it is to the goal, cells: as the guide knows, at least straight."""
    straight, (layers, block, share) = gap(nodes, v, ends, 1), guide
    i, j, k = int(nodes[v, 0]) // block, int(nodes[v, 1]) // block, int(nodes[v, 2]) // block
    if i >= layers.shape[0] or j >= layers.shape[1] or k >= layers.shape[2] or layers[i, j, k] == FAR:
        return straight
    return max(straight, share * block * layers[i, j, k])


@njit(cache=True, nogil=True)
def _level(steps, nodes, v, levels):  # type: ignore[no-untyped-def]
    """How coarse the lattice is there."""
    jump, level = steps[int(nodes[v, 0]), int(nodes[v, 1]), int(nodes[v, 2])] - 1, 0
    while level < levels[1] and jump >= _JUMPS[level]:
        level += 1
    return max(level, levels[0])


@njit(cache=True, nogil=True)
def _settle(steps, v, level, tree):  # type: ignore[no-untyped-def]
    """If the parent is not in sight, the best expanded neighbour becomes the parent."""
    index, nodes, links, closed = tree
    parent, via = links[v, _PARENT], links[v, _VIA]
    if parent == via or segment_free(steps, nodes[parent], nodes[v]):
        return
    best, cost = via, nodes[via, COST] + gap(nodes, via, nodes, v)
    i0, j0, k0 = int(nodes[v, 0]) >> level, int(nodes[v, 1]) >> level, int(nodes[v, 2]) >> level
    half = (1 << level) >> 1
    for i in range(max(i0 - 1, 0), i0 + 2):
        for j in range(max(j0 - 1, 0), j0 + 2):
            for k in range(max(k0 - 1, 0), k0 + 2):
                x, y, z = (i << level) + half, (j << level) + half, (k << level) + half
                if x >= steps.shape[0] or y >= steps.shape[1] or z >= steps.shape[2]:
                    continue
                u = index[(x * steps.shape[1] + y) * steps.shape[2] + z]
                if u == 0 or u == v or not closed[u]:
                    continue
                through = nodes[u, COST] + gap(nodes, u, nodes, v)
                if through < cost and segment_free(steps, nodes[u], nodes[v]):
                    best, cost = u, through
    links[v, _PARENT], nodes[v, COST] = best, cost


@njit(cache=True, nogil=True)
def _offer(steps, ends, v, level, bound, guide, tree, heap, counts):  # type: ignore[no-untyped-def]
    """Offer every neighbour of `v` the straight way from the parent of `v`."""
    index, nodes, links, closed = tree
    parent = links[v, _PARENT]
    from_ = parent if parent > 0 else v
    i0, j0, k0 = int(nodes[v, 0]) >> level, int(nodes[v, 1]) >> level, int(nodes[v, 2]) >> level
    half = (1 << level) >> 1
    for i in range(max(i0 - 1, 0), i0 + 2):
        for j in range(max(j0 - 1, 0), j0 + 2):
            for k in range(max(k0 - 1, 0), k0 + 2):
                x, y, z = (i << level) + half, (j << level) + half, (k << level) + half
                if x >= steps.shape[0] or y >= steps.shape[1] or z >= steps.shape[2] or steps[x, y, z] == 0:
                    continue
                u = index[(x * steps.shape[1] + y) * steps.shape[2] + z]
                if u == 0 or not closed[u]:
                    _hang(steps, ends, (v, from_), (x, y, z), bound, guide, tree, heap, counts)


@njit(cache=True, nogil=True)
def _hang(steps, ends, above, place, bound, guide, tree, heap, counts):  # type: ignore[no-untyped-def]
    """The node of a cell hangs on `above`[1], found through `above`[0], if that is cheaper than before."""
    index, nodes, links, closed = tree
    cell = (place[0] * steps.shape[1] + place[1]) * steps.shape[2] + place[2]
    u, new = index[cell], counts[_NODES]
    if u == 0:
        u = new
        for a in range(3):
            nodes[u, a] = place[a] + _PLACE[a]
        nodes[u, COST] = NEVER
    cost = nodes[above[1], COST] + gap(nodes, above[1], nodes, u)
    if cost >= nodes[u, COST] - 1e-9:
        return
    left = _left(nodes, u, ends, guide)
    if cost + left >= bound[1] or not segment_free(steps, nodes[above[0]], nodes[u]):
        return
    if u == new:
        index[cell], links[u, _CELL], closed[u] = u, cell, False
        counts[_NODES] = new + 1
    links[u, _PARENT], links[u, _VIA], nodes[u, COST] = above[1], above[0], cost
    push(heap[0], heap[1], heap[2], cost + bound[0] * left, u)
