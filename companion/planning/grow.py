"""Growth of RRT*: sampling, parent choice, rewiring. Node 0 is the start, node 1 the goal.

Random numbers arrive as rows of uniforms, so that a run is a pure function of its draws.
Karaman and Frazzoli 2011; informed set: Gammell et al. 2014; ancestors as parents: Jeong et
al. 2019.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from companion.planning.grid import segment_free
from companion.planning.tree import AFTER, CHILD, COST, NEVER, PARENT, SIBLING, add, gap, hang, nearest

START, GOAL = 0, 1
DRAWS = 5  # uniforms per iteration
STEP, RADIUS, GOAL_BIAS, LOCAL_SHARE, LOCAL_WIDTH, BUCKET = range(6)  # settings
NODES, BEST, NEAREST = range(3)  # counts: nodes, vertices of the best path, node nearest to the goal
_PARENTS_TRIED = 6
_ANCESTORS = 6
_MOST_NEAR = 200


@njit(cache=True, nogil=True)
def grow(steps, nodes, links, head, counts, best, frame, box, draws, forced, settings):  # type: ignore[no-untyped-def]
    """One iteration per row of `draws`; the rows of `forced` (K, 3) are the first samples.

    `best` (M, 3) holds the best path, for path-local samples; `frame` (4, 3) the spheroid's
    rotation and centre, `box` (2, 3) the corners of the box that is sampled.
    """
    near, gaps = np.empty(_MOST_NEAR + _ANCESTORS, np.int32), np.empty(_MOST_NEAR + _ANCESTORS)
    stack, x, bucket = np.empty(nodes.shape[0], np.int32), np.empty((1, 3)), settings[BUCKET]
    for row in range(draws.shape[0]):
        if counts[NODES] >= nodes.shape[0]:
            return
        if row < forced.shape[0]:
            _copy(forced, row, x)
        else:
            _sample(box, draws[row], nodes, best, counts[BEST], frame, settings, x)
        if not _inside(steps.shape, x):
            continue
        closest = nearest(nodes, links, head, x, bucket)
        far = gap(nodes, closest, x, 0)
        if far > settings[STEP]:
            for k in range(3):
                x[0, k] = nodes[closest, k] + (x[0, k] - nodes[closest, k]) * settings[STEP] / far
        if far < 1e-9 or steps[int(x[0, 0]), int(x[0, 1]), int(x[0, 2])] == 0:
            continue
        radius = max(settings[RADIUS], min(far, settings[STEP]) * 1.0001)
        count = _near(nodes, links, head, x, bucket, radius, near, gaps)
        count = _with_ancestors(nodes, links, closest, x, count, near, gaps)
        found = _choose_parent(steps, nodes, x, count, near, gaps)
        if found >= 0:
            node = counts[NODES]
            counts[NODES] = node + 1
            _copy(x, 0, nodes[node : node + 1])
            add(nodes, links, head, node, near[found], bucket)
            _rewire(steps, nodes, links, node, count, near, gaps, stack)
            _connect_goal(steps, nodes, links, counts, node)


@njit(cache=True, nogil=True)
def add_chain(nodes, links, head, counts, bucket, path):  # type: ignore[no-untyped-def]
    """Hang a valid path (N, 3) that begins at the start into the tree; if it ends at the goal, that too."""
    before = START
    for n in range(1, path.shape[0]):
        if n == path.shape[0] - 1 and gap(nodes, GOAL, path, n) < 1e-9:
            reach = nodes[before, COST] + gap(nodes, before, path, n)
            if reach < nodes[GOAL, COST]:
                nodes[GOAL, COST] = reach
                hang(links, GOAL, before)
            return
        node = counts[NODES]
        if node >= nodes.shape[0]:
            return
        counts[NODES] = node + 1
        _copy(path, n, nodes[node : node + 1])
        add(nodes, links, head, node, before, bucket)
        before = node


@njit(cache=True, nogil=True)
def _copy(points, n, x):  # type: ignore[no-untyped-def]
    for k in range(3):
        x[0, k] = points[n, k]


@njit(cache=True, nogil=True)
def _sample(box, u, nodes, best, best_count, frame, settings, x):  # type: ignore[no-untyped-def]
    """Goal or anywhere without a path; with one, near it or in the informed spheroid."""
    c_best = nodes[GOAL, COST]
    if c_best >= NEVER:
        for k in range(3):
            anywhere = box[0, k] + u[1 + k] * (box[1, k] - box[0, k])
            x[0, k] = nodes[GOAL, k] if u[0] < settings[GOAL_BIAS] else anywhere
        return
    if best_count > 1 and u[0] < settings[LOCAL_SHARE]:
        place = u[0] / settings[LOCAL_SHARE] * (best_count - 1)
        v = min(int(place), best_count - 2)
        width = 1.0 + u[4] * u[4] * settings[LOCAL_WIDTH]
        for k in range(3):
            x[0, k] = best[v, k] + (place - v) * (best[v + 1, k] - best[v, k]) + (u[1 + k] - 0.5) * width
        return
    # uniform in the unit ball, then stretched: major axis c_best, minor sqrt(c_best^2 - c_min^2)
    height, turn, radius = 2.0 * u[1] - 1.0, 2.0 * math.pi * u[2], u[3] ** (1.0 / 3.0)
    flat = radius * math.sqrt(max(1.0 - height * height, 0.0))
    minor = 0.5 * math.sqrt(max(c_best * c_best - gap(nodes, START, nodes, GOAL) ** 2, 0.0))
    a, b, c = 0.5 * c_best * radius * height, minor * flat * math.cos(turn), minor * flat * math.sin(turn)
    for k in range(3):
        x[0, k] = frame[3, k] + frame[k, 0] * a + frame[k, 1] * b + frame[k, 2] * c


@njit(cache=True, nogil=True)
def _inside(shape, x):  # type: ignore[no-untyped-def]
    return 0.0 <= x[0, 0] < shape[0] and 0.0 <= x[0, 1] < shape[1] and 0.0 <= x[0, 2] < shape[2]


@njit(cache=True, nogil=True)
def _near(nodes, links, head, x, bucket, radius, near, gaps):  # type: ignore[no-untyped-def]
    """Nodes within the radius; returns how many."""
    count = 0
    i0, i1 = max(int((x[0, 0] - radius) / bucket), 0), min(int((x[0, 0] + radius) / bucket) + 1, head.shape[0])
    j0, j1 = max(int((x[0, 1] - radius) / bucket), 0), min(int((x[0, 1] + radius) / bucket) + 1, head.shape[1])
    k0, k1 = max(int((x[0, 2] - radius) / bucket), 0), min(int((x[0, 2] + radius) / bucket) + 1, head.shape[2])
    for i in range(i0, i1):
        for j in range(j0, j1):
            for k in range(k0, k1):
                q = head[i, j, k]
                while q >= 0:
                    here = gap(nodes, q, x, 0)
                    if here <= radius and count < _MOST_NEAR:
                        near[count], gaps[count] = q, here
                        count += 1
                    q = links[q, AFTER]
    return count


@njit(cache=True, nogil=True)
def _with_ancestors(nodes, links, node, x, count, near, gaps):  # type: ignore[no-untyped-def]
    """The nearest node and its ancestors may be parents from farther away: straighter paths."""
    q, end = node, count + _ANCESTORS
    while q >= 0 and count < end:
        near[count], gaps[count] = q, gap(nodes, q, x, 0)
        count += 1
        q = links[q, PARENT]
    return count


@njit(cache=True, nogil=True)
def _choose_parent(steps, nodes, x, count, near, gaps):  # type: ignore[no-untyped-def]
    """Place in `near` of the cheapest parent with a free edge; -1: none of the few best."""
    to_goal, last = gap(nodes, GOAL, x, 0), -1.0
    for _ in range(_PARENTS_TRIED):
        found, least = -1, NEVER
        for n in range(count):
            total = nodes[near[n], COST] + gaps[n]
            if last < total < least:
                found, least = n, total
        if found < 0 or least + to_goal >= nodes[GOAL, COST]:
            return -1
        if segment_free(steps, nodes[near[found]], x[0]):
            return found
        last = least
    return -1


@njit(cache=True, nogil=True)
def _rewire(steps, nodes, links, node, count, near, gaps, stack):  # type: ignore[no-untyped-def]
    """Near nodes that are reached cheaper through the new node hang on it."""
    for n in range(count):
        q = near[n]
        change = nodes[node, COST] + gaps[n] - nodes[q, COST]
        if change > -1e-6 or nodes[q, COST] + change + gap(nodes, q, nodes, GOAL) >= nodes[GOAL, COST]:
            continue
        if not segment_free(steps, nodes[node], nodes[q]):
            continue
        hang(links, q, node)
        stack[0], size = q, 1
        while size > 0:
            size -= 1
            below = stack[size]
            nodes[below, COST] += change
            below = links[below, CHILD]
            while below >= 0:
                stack[size] = below
                size += 1
                below = links[below, SIBLING]


@njit(cache=True, nogil=True)
def _connect_goal(steps, nodes, links, counts, node):  # type: ignore[no-untyped-def]
    """Try the straight way to the goal; remember which node is nearest to it."""
    here = gap(nodes, node, nodes, GOAL)
    if here < gap(nodes, counts[NEAREST], nodes, GOAL):
        counts[NEAREST] = node
    if nodes[node, COST] + here < nodes[GOAL, COST] - 1e-6 and segment_free(steps, nodes[node], nodes[GOAL]):
        hang(links, GOAL, node)
        nodes[GOAL, COST] = nodes[node, COST] + here
