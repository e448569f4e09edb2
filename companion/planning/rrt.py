"""RRT (LaValle 1998) with goal bias, and RRT-Connect (Kuffner and LaValle 2000), as the textbooks have them.

Both stop at their first path; neither shortens it.

>>> plan = RRT(RRTConfig()).plan(start, goal, space, rng=np.random.default_rng(1), iterations=5000)
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

import msgspec
import numpy as np
from numba import njit
from numpy.typing import NDArray

from companion.core.messages import Array
from companion.planning import connect as two_trees
from companion.planning.grid import segment_free
from companion.planning.planner import CellSpace, Plan, Planner, Query
from companion.planning.polyline import length, without_repeats
from companion.planning.tree import COST, PARENT, add, gap, nearest, way_to

_CHUNK = 20  # iterations between two looks whether there is a path
_DRAWS = 4  # uniforms per iteration of RRT
_START = 0


class RRTConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """How RRT and RRT-Connect grow."""

    step_m: Annotated[float, msgspec.Meta(gt=0)] = 3.0
    """Longest new edge."""
    goal_bias: Annotated[float, msgspec.Meta(ge=0, le=1)] = 0.05
    """Share of RRT's samples at the goal."""
    bucket_m: Annotated[float, msgspec.Meta(gt=0)] = 2.4
    """Edge of the nearest-neighbour buckets."""


class RRT(Planner):
    """One tree from the start; the path is whatever branch meets the goal first."""

    def __init__(self, config: RRTConfig) -> None:
        self.config = config
        self._last: tuple[_Trees, list[int], CellSpace] | None = None

    def edges(self) -> Array:
        """All edges (E, 2, 3) of the last plan's search, odom, m: for pictures."""
        return _edges(*self._last) if self._last else np.empty((0, 2, 3))

    def search(self, query: Query) -> Plan:
        """First way found with at most `iterations` samples; `known_path` changes nothing."""
        start, goal, space = query.start, query.goal, query.space
        ends, trees = space.to_cells(np.stack([start, goal])), _Trees.of(1, query.iterations, space, self.config)
        trees.plant(0, ends[0])
        tree, step = (trees.nodes[0], trees.links[0], trees.heads[0]), self.config.step_m / space.resolution_m
        settings = np.array([step, self.config.goal_bias, trees.bucket])
        count, done, joined = 1, 0, False
        while done < query.iterations and not joined:
            draws = query.rng.random((min(_CHUNK, query.iterations - done), _DRAWS))
            count, used, joined = _grow(space.steps, *tree, count, ends[1], space.sample_box, draws, settings)
            done += used
        self._last = trees, [count], space
        last = count - 1 if joined else int(np.argmin(np.linalg.norm(tree[0][:count, :3] - ends[1], axis=1)))
        return _plan(space, trees, last, (start, goal), done, joined)


class RRTConnect(Planner):
    """Two trees that grow towards each other."""

    def __init__(self, config: RRTConfig) -> None:
        self.config = config
        self._last: tuple[_Trees, list[int], CellSpace] | None = None

    def edges(self) -> Array:
        """All edges (E, 2, 3) of the last plan's search, odom, m: for pictures."""
        return _edges(*self._last) if self._last else np.empty((0, 2, 3))

    def search(self, query: Query) -> Plan:
        """First way found with at most `iterations` samples, in whole chunks; `known_path` changes nothing."""
        start, goal, space = query.start, query.goal, query.space
        ends, step = space.to_cells(np.stack([start, goal])), self.config.step_m / space.resolution_m
        reach = int(sum(space.steps.shape) / step) + 2  # nodes of one long extension
        trees = _Trees.of(2, query.iterations * reach, space, self.config)
        for which in (0, 1):
            trees.plant(which, ends[which])
        counts, path, done, points = np.array([1, 1]), np.zeros((4096, 3)), 0, 0
        while done < query.iterations and not points:
            draws = query.rng.random((_CHUNK, two_trees.DRAWS))
            done += _CHUNK
            arguments = (counts, space.sample_box, draws, step, trees.bucket, path)
            points = two_trees.connect(space.steps, trees.nodes, trees.links, trees.heads, *arguments)
        self._last = trees, counts.tolist(), space
        if points:
            way = _ended(space.to_odom(without_repeats(path[:points])), start, goal)
            return Plan(path=way, cost_m=length(way), iterations=done, solved=True)
        last = int(np.argmin(np.linalg.norm(trees.nodes[0, : counts[0], :3] - ends[1], axis=1)))
        return _plan(space, trees, last, (start, goal), done, False)


@dataclass(frozen=True, slots=True, eq=False)
class _Trees:
    """Trees in flat arrays, see `tree`."""

    nodes: Array
    links: NDArray[np.int32]
    heads: NDArray[np.int32]
    bucket: float

    @classmethod
    def of(cls, trees: int, nodes: int, space: CellSpace, config: RRTConfig) -> _Trees:
        bucket = config.bucket_m / space.resolution_m
        grid = tuple(math.ceil(n / bucket) for n in space.steps.shape)
        links = np.full((trees, nodes + 2, 4), -1, np.int32)
        return cls(np.zeros((trees, nodes + 2, 4)), links, np.full((trees, *grid), -1, np.int32), bucket)

    def plant(self, which: int, root: Array) -> None:
        """Give an empty tree its root (3,)."""
        self.nodes[which, 0, :3], self.nodes[which, 0, COST] = root, 0.0
        add(self.nodes[which], self.links[which], self.heads[which], 0, -1, self.bucket)


def _plan(space: CellSpace, trees: _Trees, last: int, ends: tuple[Array, Array], done: int, solved: bool) -> Plan:
    """The branch of tree 0 that ends at node `last`; every node has fewer ancestors than there are nodes."""
    out = np.zeros((len(trees.nodes[0]), 3))
    count = int(way_to(trees.nodes[0], trees.links[0], last, out))
    path = space.to_odom(out[:count])
    path[0] = ends[0]
    if solved:
        path = _ended(path, *ends)
    return Plan(path=path, cost_m=length(path) if solved else math.inf, iterations=done, solved=solved)


def _edges(trees: _Trees, counts: list[int], space: CellSpace) -> Array:
    """All edges (E, 2, 3) of trees with so many nodes, odom, m."""
    pairs = []
    for nodes, links, count in zip(trees.nodes, trees.links, counts, strict=True):
        ends = nodes[1:count, :3], nodes[links[1:count, PARENT], :3]
        pairs.append(np.stack(ends, axis=1))
    return space.to_odom(np.concatenate(pairs))


def _ended(path: Array, start: Array, goal: Array) -> Array:
    """The path with its ends exactly where asked: cells and back are rounded."""
    path[0], path[-1] = start, goal
    return path


@njit(cache=True, nogil=True)
def _grow(steps, nodes, links, head, count, goal, box, draws, settings):  # type: ignore[no-untyped-def]
    """One iteration per row of `draws`, until the goal is met: nodes, rows used, was the goal met.

    settings: longest edge, share of samples at the goal, edge of the buckets; cells.
    """
    step, bias, bucket = settings
    for row in range(draws.shape[0]):
        new = count
        for k in range(3):
            anywhere = box[0, k] + draws[row, 1 + k] * (box[1, k] - box[0, k])
            nodes[new, k] = goal[k] if draws[row, 0] < bias else anywhere
        before = nearest(nodes, links, head, nodes[new : new + 1], bucket)
        far = gap(nodes, before, nodes, new)
        if far > step:
            for k in range(3):
                nodes[new, k] = nodes[before, k] + (nodes[new, k] - nodes[before, k]) * step / far
        if far < 1e-9 or not segment_free(steps, nodes[before], nodes[new]):
            continue
        add(nodes, links, head, new, before, bucket)
        count += 1
        if _reach(steps, nodes, new, goal, step):
            for k in range(3):
                nodes[count, k] = goal[k]
            if gap(nodes, new, nodes, count) > 1e-9:
                add(nodes, links, head, count, new, bucket)
                count += 1
            return count, row + 1, True
    return count, draws.shape[0], False


@njit(cache=True, nogil=True)
def _reach(steps, nodes, node, goal, step):  # type: ignore[no-untyped-def]
    """Is the goal within a step, and in sight?"""
    far2 = (nodes[node, 0] - goal[0]) ** 2 + (nodes[node, 1] - goal[1]) ** 2 + (nodes[node, 2] - goal[2]) ** 2
    return far2 <= step * step and segment_free(steps, nodes[node], goal)
