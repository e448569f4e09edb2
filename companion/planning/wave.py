"""A wave from the goal through free cells: its layers are about the distance to go, around every wall.

A column of 64 blocks of cells is one word, so a layer spreads along it in two shifts, and to the columns beside it by
one AND each. Two layers go to the six blocks that share a face, then one to all 26 neighbours (the octagonal distances
of Rosenfeld and Pfaltz 1968): the distance is between 0.96 and 1.11 times the layers. A step to a diagonal neighbour
goes along one axis after the other through free blocks, so that what is reached is joined by faces.

>>> wave = Wave(space.steps, ends_cells, block=2)
>>> wave.reached, wave.path()  # (N, 3), cells: a free way down the layers, from corner to corner in sight
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from companion.core.messages import Array
from companion.planning.grid import segment_free
from companion.planning.reach import WORD

FAR = 65535  # layer of what was not reached
_MOST_POINTS = 8192
_ROUND = 3  # every so manieth layer goes to all 26 neighbours
_DE_BRUIJN = 0x03F79D71B4CB0A89
_PLACE_OF = np.zeros(WORD, np.uint8)  # of a word's only bit
_PLACE_OF[[((1 << n) * _DE_BRUIJN & (1 << WORD) - 1) >> 58 for n in range(WORD)]] = np.arange(WORD)


class Wave:
    """Layers of cubes of `block`^3 cells that are free as a whole, from ends[1] until ends[0], (2, 3) cells."""

    def __init__(self, steps: NDArray[np.uint8], ends: Array, *, block: int) -> None:
        self._steps, self._ends, self.block = steps, np.ascontiguousarray(ends, np.float64), block
        shape = np.array(steps.shape) // block
        free = np.zeros(shape, np.uint8)
        find_free(steps, block, free)
        across = np.abs(ends[1] - ends[0])
        # The front lies across the way: words along it hold many of its blocks, so that each is looked at seldom.
        self._axes = np.array([0, 2, 1] if across[0] >= across[1] else [1, 2, 0])
        self._layers = np.full(shape[self._axes], FAR, np.uint16)
        doors = (_doors(steps, free, end, block)[:, self._axes] for end in self._ends)
        self._start, goal = (np.ascontiguousarray(blocks) for blocks in doors)
        self._door = -1
        if len(self._start) and len(goal):
            words = _words(free.transpose(self._axes))
            self._door = int(spread(words, self._layers, goal, self._start, _PLACE_OF))

    @property
    def reached(self) -> bool:
        """Did the wave come to the start?"""
        return self._door >= 0

    @property
    def layers(self) -> NDArray[np.uint16]:
        """Of all blocks (X, Y, Z); FAR: not reached."""
        return self._layers.transpose(np.argsort(self._axes))

    def path(self) -> Array:
        """The free way from start to goal, corners (N, 3) in cells; empty: none, or longer than memory allows."""
        way = np.zeros((_MOST_POINTS, 3))
        if not self.reached:
            return way[:0]
        door = np.ascontiguousarray(self._start[self._door])
        return way[: descend(self._steps, self._layers, door, self._axes, self._ends, self.block, way)]


def _doors(steps: NDArray[np.uint8], free: NDArray[np.uint8], end: Array, block: int) -> NDArray[np.int64]:
    """Free blocks (K, 3) around an end whose middle is in sight of it, the end's own first."""
    home = np.floor(end / block).astype(np.int64)
    near = home + np.stack(np.meshgrid(*[(0, -1, 1)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    near = near[np.all((near >= 0) & (near < free.shape), axis=1)]
    near = near[free[tuple(near.T)] > 0]
    seen = [bool(segment_free(steps, (cell + 0.5) * block, end)) for cell in near]
    doors: NDArray[np.int64] = near[np.array(seen, np.bool_)]
    return doors


def _words(free: NDArray[np.uint8]) -> NDArray[np.uint64]:
    """Blocks (A, B, C) as bits along C, with a rim of empty words around, (A + 2, B + 2, W)."""
    a, b, c = free.shape
    packed = np.zeros((a + 2, b + 2, -(-c // WORD) * WORD // 8), np.uint8)
    packed[1:-1, 1:-1, : -(-c // 8)] = np.packbits(free, axis=2, bitorder="little")
    return packed.view("<u8").astype(np.uint64, copy=False)


@njit(cache=True, nogil=True)
def find_free(steps, block, free):  # type: ignore[no-untyped-def]
    """1 for the cubes of `block`^3 cells that are free as a whole; cells beyond the last whole cube are dropped."""
    height = free.shape[2] * block
    clear = np.empty(height, np.bool_)
    for i in range(free.shape[0]):
        for j in range(free.shape[1]):
            clear[:] = True
            for a in range(i * block, (i + 1) * block):
                for b in range(j * block, (j + 1) * block):
                    column = steps[a, b]
                    for k in range(height):
                        clear[k] &= column[k] != 0
            for k in range(free.shape[2]):
                whole = True
                for c in range(k * block, (k + 1) * block):
                    whole &= clear[c]
                free[i, j, k] = whole


@njit(cache=True, nogil=True)
def spread(free, layers, goal, start, place_of):  # type: ignore[no-untyped-def]
    """Number the layers from the blocks `goal` (K, 3); the index of the first of `start` (L, 3) met, or -1."""
    nx, ny, words = free.shape
    front, queue = np.zeros((2, nx, ny, words), np.uint64), np.empty((2, nx * ny, 2), np.int32)
    waits, todo = np.zeros((nx, ny), np.bool_), free.copy()
    count, now, layer = 0, 0, 0
    for n in range(goal.shape[0]):
        i, j, w = goal[n, 0] + 1, goal[n, 1] + 1, goal[n, 2] // WORD
        bit = np.uint64(1) << np.uint64(goal[n, 2] % WORD)
        front[0, i, j, w] |= bit
        todo[i, j, w] &= ~bit
        if not waits[i, j]:
            waits[i, j] = True
            queue[0, count, 0], queue[0, count, 1] = i, j
            count += 1
    while count > 0 and layer < FAR - 1:
        _number(front[now], waits, queue[now], count, layers, layer, place_of)
        for n in range(start.shape[0]):
            if layers[start[n, 0], start[n, 1], start[n, 2]] != FAR:
                return n
        layer, after = layer + 1, 1 - now
        if layer % _ROUND == 0:
            count = _to_all(free, todo, front[now], front[after], waits, queue[now], queue[after], count)
        else:
            count = _to_faces(todo, front[now], front[after], waits, queue[now], queue[after], count)
        now = after
    return -1


@njit(cache=True, nogil=True)
def _number(front, waits, queue, count, layers, layer, place_of):  # type: ignore[no-untyped-def]
    """Write the layer of all blocks of the front; none of its columns waits any more."""
    for c in range(count):
        i, j = queue[c, 0], queue[c, 1]
        waits[i, j] = False
        for w in range(front.shape[2]):
            word = front[i, j, w]
            while word != 0:
                low = word & (~word + np.uint64(1))
                layers[i - 1, j - 1, w * WORD + place_of[(low * np.uint64(_DE_BRUIJN)) >> np.uint64(58)]] = layer
                word ^= low


@njit(cache=True, nogil=True)
def _to_faces(todo, front, later, waits, queue, next_queue, count):  # type: ignore[no-untyped-def]
    """From the blocks of the front to their six neighbours that were not reached; columns of the new front."""
    more, words, one, top = 0, front.shape[2], np.uint64(1), np.uint64(WORD - 1)
    for c in range(count):
        i, j = queue[c, 0], queue[c, 1]
        for w in range(words):
            word = front[i, j, w]
            below = front[i, j, w - 1] >> top if w > 0 else np.uint64(0)
            above = front[i, j, w + 1] << top if w + 1 < words else np.uint64(0)
            for n in range(5):
                a, b = i + (n == 1) - (n == 2), j + (n == 3) - (n == 4)
                spread_to = word if n > 0 else word << one | word >> one | below | above
                new = spread_to & todo[a, b, w]
                if new != 0:
                    more = _reach(todo, later, waits, next_queue, more, (a, b, w), new)
    _wipe(front, queue, count)
    return more


@njit(cache=True, nogil=True)
def _to_all(free, todo, front, later, waits, queue, next_queue, count):  # type: ignore[no-untyped-def]
    """The same to all 26 neighbours: across the first axis, then the second, then along the words."""
    more, words, one, top = 0, front.shape[2], np.uint64(1), np.uint64(WORD - 1)
    for c in range(count):
        i, j = queue[c, 0], queue[c, 1]
        for w in range(words):
            for a in range(i - 1, i + 2):
                beside = front[i, j, w] & free[a, j, w]
                below = front[i, j, w - 1] & free[a, j, w - 1] if w > 0 else np.uint64(0)
                above = front[i, j, w + 1] & free[a, j, w + 1] if w + 1 < words else np.uint64(0)
                if (beside | below | above) == 0:
                    continue
                for b in range(j - 1, j + 2):
                    there = beside & free[a, b, w]
                    there |= there << one | there >> one
                    if w > 0:
                        there |= (below & free[a, b, w - 1]) >> top
                    if w + 1 < words:
                        there |= (above & free[a, b, w + 1]) << top
                    new = there & todo[a, b, w]
                    if new != 0:
                        more = _reach(todo, later, waits, next_queue, more, (a, b, w), new)
    _wipe(front, queue, count)
    return more


@njit(cache=True, nogil=True)
def _reach(todo, later, waits, next_queue, more, word, new):  # type: ignore[no-untyped-def]
    """Blocks `new` of a word are reached; its column queues once. Returns the length of the queue."""
    a, b, w = word
    todo[a, b, w] ^= new
    later[a, b, w] |= new
    if waits[a, b]:
        return more
    waits[a, b] = True
    next_queue[more, 0], next_queue[more, 1] = a, b
    return more + 1


@njit(cache=True, nogil=True)
def _wipe(front, queue, count):  # type: ignore[no-untyped-def]
    for c in range(count):
        front[queue[c, 0], queue[c, 1]] = 0


@njit(cache=True, nogil=True)
def descend(steps, layers, door, axes, ends, block, way):  # type: ignore[no-untyped-def]
    """Write the way (N, 3) from ends[0] through block `door` down the layers to ends[1]; its number of points.

    From each corner as far as the way ahead is in sight. 0: `way` is too short. Axis n of the layers is axes[n] of
    the cells.
    """
    here, after, bends = door.copy(), door.copy(), np.empty((3, 3))
    way[0] = ends[0]
    for n in range(3):
        way[1, axes[n]] = (here[n] + 0.5) * block
    count = 2  # the last point is where the way has come to
    while layers[here[0], here[1], here[2]] > 0:
        if count + 4 > way.shape[0]:
            return 0
        _next_below(layers, here, after)
        for n in range(3):
            for m in range(3):
                bends[n, axes[m]] = ((after[m] if m >= 2 - n else here[m]) + 0.5) * block
        first = 2 if segment_free(steps, way[count - 1], bends[2]) else 0
        if segment_free(steps, way[count - 2], bends[2]):
            count, first = count - 1, 2
        for n in range(first, 3):
            way[count] = bends[n]
            count += 1
        here[:] = after
    if segment_free(steps, way[count - 2], ends[1]):
        count -= 1
    way[count] = ends[1]
    return count + 1


@njit(cache=True, nogil=True)
def _next_below(layers, here, after):  # type: ignore[no-untyped-def]
    """The neighbour where the layers fall most per length, of those from which the wave may have come."""
    i, j, k = here[0], here[1], here[2]
    own, best = layers[i, j, k], 0.0
    for a in range(max(i - 1, 0), min(i + 2, layers.shape[0])):
        for b in range(max(j - 1, 0), min(j + 2, layers.shape[1])):
            for c in range(max(k - 1, 0), min(k + 2, layers.shape[2])):
                if layers[a, b, c] >= own or layers[i, b, c] == FAR or layers[i, j, c] == FAR:
                    continue
                fall = (own - layers[a, b, c]) / math.sqrt((a - i) ** 2 + (b - j) ** 2 + (c - k) ** 2)
                if fall > best:
                    best, after[0], after[1], after[2] = fall, a, b, c
