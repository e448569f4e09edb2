"""A* (Hart, Nilsson and Raphael 1968) on a padded grid; without a heuristic it is Dijkstra's algorithm.

Nodes are flat indices of the padded grid, whose rim is blocked. label: 0 unseen; 1 + move that led here, with CLOSED
once expanded. A node that gets a cheaper way is opened again, so the order within a bucket of the open list does not
matter: with an admissible bound the cost is the least.

In open space only the moves that may follow the one before are tried (`Moves.natural`). `given` collects them over
all equally cheap ways to a node; what a closed node is given later opens it AGAIN for those moves alone.

A weighted search tries all moves and opens no node again (Likhachev, Gordon and Thrun 2003): its cost is at most the
weight times the least, and a bucket.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from companion.planning.lattice.heuristics import estimate
from companion.planning.lattice.open_list import BUCKET, PER_CELL, ROOM, empty_list, pop, push, with_room

CLOSED, AGAIN, MOVE = 64, 32, 31  # flags, and the bits of the move
NEVER = 1e30
SAME = 1e-9  # cells; less is rounding


@njit(cache=True, nogil=True)
def search(blocked, shape, moves, ends, bound, scratch):  # type: ignore[no-untyped-def]
    """Cost of the way, number of expansions, and every node seen.

    blocked (V,), bits of the cells below, at and above each; shape (3,) of the padded grid; moves = flat offsets (M,)
    and the arrays of `Moves`; ends = start, goal; bound = heuristic's number, weight, whether the cost must be the
    least; scratch = label (V,), all 0, cost (V,), given (V,): they hold the answer.
    """
    start, goal = ends
    label, cost, given = scratch
    open_list, to = empty_list(), unflat(goal, shape)
    heads, pool, state = open_list
    seen, count, expanded, best = np.empty(4096, np.int32), 1, 0, NEVER
    seen[0], cost[start], label[start], given[start] = start, 0.0, 1, moves[4][-1]
    f = bound[1] * _bound_at(bound[0], unflat(start, shape), to)
    state[BUCKET] = int(f * PER_CELL)
    push(heads, pool, state, start, f)
    while True:
        v = pop(heads, pool, state, best)
        if v < 0:
            return best, expanded, seen[:count]
        if label[v] & CLOSED:
            continue
        label[v] |= CLOSED
        if v == goal:
            best = cost[v]
            continue
        at = unflat(v, shape)
        if cost[v] + bound[1] * _bound_at(bound[0], at, to) >= best - SAME:
            continue
        expanded += 0 if label[v] & AGAIN else 1
        pool = with_room(pool, state, ROOM)
        seen = with_space(seen, count)
        walls = surroundings(blocked, v, shape)
        if walls or not bound[2]:
            given[v] = moves[4][-1]
        left = (at[0] - to[0], at[1] - to[1], at[2] - to[2])
        count = _relax(v, walls, left, moves, bound, best, scratch, (heads, pool, state), seen, count)


@njit(cache=True, nogil=True)
def _relax(v, walls, left, moves, bound, best, scratch, open_list, seen, count):  # type: ignore[no-untyped-def]
    """Offer every neighbour of `v` the way through it; returns how many nodes were seen so far."""
    flat, offsets, lengths, needs, natural = moves
    label, cost, given = scratch
    heads, pool, state = open_list
    rest, m = given[v], -1
    while rest:
        rest, tried, m = rest >> np.uint32(1), rest & np.uint32(1), m + 1
        if not tried or walls & needs[m]:
            continue
        u, way, more, again = v + flat[m], cost[v] + lengths[m], natural[m], 0
        if label[u] & CLOSED and not bound[2]:
            continue
        if label[u] and way >= cost[u] - SAME:
            more &= ~given[u]
            if way > cost[u] + SAME or not more:
                continue
            if not label[u] & CLOSED:  # as cheap as before: other moves may follow, too
                given[u] |= more
                continue
            again = AGAIN
        dx, dy, dz = left[0] + offsets[m, 0], left[1] + offsets[m, 1], left[2] + offsets[m, 2]
        f = way + bound[1] * estimate(bound[0], abs(dx), abs(dy), abs(dz))
        if f >= best - SAME:
            continue
        if label[u] == 0:
            seen[count] = u
            count += 1
        label[u], cost[u], given[u] = (1 + m) | again, way, more
        push(heads, pool, state, u, f)
    return count


@njit(cache=True, nogil=True)
def walk_back(flat, ends, label):  # type: ignore[no-untyped-def]
    """The nodes (N,) from start to goal, along the moves that led there."""
    start, goal = ends
    count, v = 1, goal
    while v != start:
        v -= flat[(label[v] & MOVE) - 1]
        count += 1
    nodes, v = np.empty(count, np.int64), goal
    for n in range(count - 1, -1, -1):
        nodes[n] = v
        if n > 0:
            v -= flat[(label[v] & MOVE) - 1]
    return nodes


@njit(cache=True, nogil=True)
def surroundings(blocked, v, shape):  # type: ignore[no-untyped-def]
    """Bit set of the blocked cells among the 27 around a node; `blocked` holds three of a column in each place."""
    walls, place = np.uint32(0), np.uint32(0)
    for a in range(-1, 2):
        for b in range(-1, 2):
            walls |= np.uint32(blocked[v + (a * shape[1] + b) * shape[2]]) << place
            place += np.uint32(3)
    return walls


@njit(cache=True, nogil=True)
def unflat(v, shape):  # type: ignore[no-untyped-def]
    """Indices along the axes."""
    height, width = np.uint32(shape[2]), np.uint32(shape[1])
    row = np.uint32(v) // height  # unsigned: half the time of signed division
    i = row // width
    return np.int64(i), np.int64(row - i * width), np.int64(np.uint32(v) - row * height)


@njit(cache=True, nogil=True)
def _bound_at(kind, p, q):  # type: ignore[no-untyped-def]
    return estimate(kind, abs(p[0] - q[0]), abs(p[1] - q[1]), abs(p[2] - q[2]))


@njit(cache=True, nogil=True)
def with_space(nodes, count):  # type: ignore[no-untyped-def]
    """The list, or a longer copy, with space for all neighbours of a node."""
    if count + ROOM <= len(nodes):
        return nodes
    larger = np.empty(2 * len(nodes), nodes.dtype)
    for n in range(len(nodes)):
        larger[n] = nodes[n]
    return larger
