"""RRT* in 3D: anytime, informed, seeded with what is known.

>>> plan = RRTStar(RRTStarConfig()).plan(start, goal, space, rng=np.random.default_rng(1), iterations=1000)
"""

from __future__ import annotations

import math
from typing import Annotated

import msgspec
import numpy as np
from numpy.typing import NDArray

from companion.core.messages import Array
from companion.planning import best_path, grow, shortcut
from companion.planning import connect as two_trees
from companion.planning import detour as other_side
from companion.planning.planner import CellSpace, Plan, Planner, Query
from companion.planning.polyline import length, without_repeats
from companion.planning.tree import NEVER, PARENT, drop_repeats, way_to
from companion.planning.trees import FROM_GOAL, FROM_START, OWN, Trees

_SPARE_NODES = 2048  # for chains of known and shortened paths


class RRTStarConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """How the tree grows."""

    step_m: Annotated[float, msgspec.Meta(gt=0)] = 6.0
    """Longest new edge."""
    first: bool = True
    """Find the first path with RRT-Connect; false: RRT* alone, with goal bias."""
    goal_bias: Annotated[float, msgspec.Meta(ge=0, le=1)] = 0.1
    """Share of samples at the goal while RRT* has no path."""
    local_share: Annotated[float, msgspec.Meta(ge=0, lt=1)] = 0.4
    """Share of samples around the best path."""
    local_width_m: Annotated[float, msgspec.Meta(gt=0)] = 6.0
    """Widest box around the best path for these."""
    radius_factor: Annotated[float, msgspec.Meta(ge=1)] = 1.1
    """Neighbourhood radius over the least one with proven convergence."""
    chunk: Annotated[int, msgspec.Meta(ge=10)] = 100
    """Iterations between two rounds of shortening."""
    shortcuts: Annotated[int, msgspec.Meta(ge=0)] = 60
    """Attempts per round of shortening."""
    easy_chunks: Annotated[int, msgspec.Meta(ge=0)] = 4
    """If more chunks than these were needed to find the first path, RRT-Connect goes on looking for others."""
    restart_chunks: Annotated[int, msgspec.Meta(ge=0)] = 4
    """Chunks of it beside one of RRT*."""
    restart_shortcuts: Annotated[int, msgspec.Meta(ge=0)] = 200
    """Attempts to shorten each of those."""
    bucket_m: Annotated[float, msgspec.Meta(gt=0)] = 2.4
    """Edge of the nearest-neighbour buckets."""


class RRTStar(Planner):
    """Keeps only scratch memory, so a plan depends on its arguments alone."""

    straight_first = True

    def __init__(self, config: RRTStarConfig) -> None:
        self.config = config
        self._memory: Trees | None = None
        self._last: Search | None = None

    def edges(self) -> Array:
        """All edges (E, 2, 3) of the last plan's tree, odom, m: for pictures."""
        return self._last.edges() if self._last else np.empty((0, 2, 3))

    def search(self, query: Query) -> Plan:
        """Shortest way found with at most `iterations` samples (rounded up to whole chunks).

        `start`, `goal` (3,) odom; both must be free. `known_path` (N, 3), say the rest of the
        old path, need not be valid or fit the ends. With more iterations and the same `rng`
        state the cost never rises.
        """
        search = self._last = self.begin(query)
        done = 0
        while done < query.iterations:
            search.advance(query.rng)
            done += self.config.chunk
        return search.result(done)

    def begin(self, query: Query) -> Search:
        """A search with memory for so many samples; it uses this planner's memory, so one at a time."""
        memory = self._scratch(query.space, query.iterations)
        search = Search(self.config, query.space, memory, query.start, query.goal)
        if query.known_path is not None and len(query.known_path):
            search.take_known(query.known_path)
        return search

    def _scratch(self, space: CellSpace, iterations: int) -> Trees:
        nodes = iterations + self.config.chunk + _SPARE_NODES
        bucket = self.config.bucket_m / space.resolution_m
        grid = tuple(math.ceil(cells / bucket) for cells in space.steps.shape)
        memory = self._memory
        if memory is None or memory.nodes.shape[1] < nodes or memory.heads.shape[1:] != grid:
            memory = self._memory = Trees.of(nodes, grid)
        return memory


class Search:
    """One run: the tree, the best path so far, and rounds of growing and shortening. Lengths in cells."""

    def __init__(self, config: RRTStarConfig, space: CellSpace, memory: Trees, start: Array, goal: Array) -> None:
        self.config, self._space, self._memory = config, space, memory
        self.ends = space.to_cells(np.stack([start, goal]))  # (2, 3)
        self._bucket = config.bucket_m / space.resolution_m
        memory.plant(OWN, self.ends, self._bucket)
        self._counts = np.array([2, 0, grow.START])
        self._tree = (memory.nodes[OWN], memory.links[OWN], memory.heads[OWN])
        self._hung = (*self._tree, self._counts, self._bucket)  # as the kernels of `best_path` take them
        self._kept = self._best, self._path = memory.kept
        self.best_cost = NEVER
        self._forced = np.zeros((0, 3))
        self._box = space.sample_box
        self._frame: Array | None = None
        self._chunks = 0  # until the first path
        self._pair: NDArray[np.int64] | None = None  # node counts of RRT-Connect's trees

    def take_known(self, path: Array) -> None:
        """Hang the valid beginning of a path into the tree; the rest become first samples."""
        points = without_repeats(np.vstack([self.ends[:1], self._space.to_cells(path)]))
        reach = np.vstack([points, self.ends[1:]])
        chain = self._space.to_odom(reach)
        valid = 1
        while valid < len(chain) and self._space.segment_free(chain[valid - 1], chain[valid]):
            valid += 1
        if valid == len(chain):
            self._hang(without_repeats(reach))
        else:
            self._hang(points[:valid])
            self._forced = np.ascontiguousarray(points[valid:])
        self._keep_if_better()

    def advance(self, rng: np.random.Generator) -> None:
        """One chunk: towards a first path, or growth; then shortening of the best path."""
        if self.solved:
            self.grow(rng)
            if self._chunks > self.config.easy_chunks:  # the first way that is found in a maze is rarely the best
                for _ in range(self.config.restart_chunks):
                    self.join(rng)
        else:
            self._chunks += 1
            self.first(rng)
        self.shorten(rng)

    def first(self, rng: np.random.Generator) -> None:
        """One chunk towards a first path: RRT-Connect, but for samples that are given, and unless configured."""
        if self.config.first and not len(self._forced):
            self.join(rng)
        else:
            self.grow(rng)

    @property
    def solved(self) -> bool:
        """Is there a path?"""
        return self.best_cost < NEVER

    @property
    def cost_m(self) -> float:
        """Length of the best path; infinite: none yet."""
        return self.best_cost * self._space.resolution_m if self.solved else math.inf

    def grow(self, rng: np.random.Generator) -> None:
        """One chunk of samples for RRT*."""
        draws = rng.random((self.config.chunk, grow.DRAWS))
        if self._frame is None:
            self._frame = np.vstack([_axes(self.ends[1] - self.ends[0]), self.ends.mean(axis=0)])
        rest = (self._counts, self._best, self._frame, self._box, draws, self._forced, self._settings())
        grow.grow(self._space.steps, *self._tree, *rest)
        self._forced = self._forced[:0]
        self._keep_if_better()

    def shorten(self, rng: np.random.Generator, attempts: int | None = None) -> None:
        """Shorten the best path; None: as often as configured."""
        count = int(self._counts[grow.BEST])
        if count > 2:
            self._path[:count] = self._best[:count]
            self._shorten(count, rng, self.config.shortcuts if attempts is None else attempts)

    def detour(self, rng: np.random.Generator, attempts: int, *, reach_m: float) -> None:
        """Try the other sides of what the best path bends about, then shorten it."""
        count = int(self._counts[grow.BEST])
        if count > 2:
            self._path[:count] = self._best[:count]
            draws = rng.random((attempts, other_side.DRAWS))
            count = other_side.detour(self._space.steps, self._path, count, draws, reach_m / self._space.resolution_m)
            self._shorten(count, rng, self.config.shortcuts)

    def offer(self, path: Array, rng: np.random.Generator, attempts: int) -> None:
        """A free path (N, 3) between the ends that another planner found: shorten it, take it if it is better."""
        if len(path) > len(self._path):
            return
        self._path[: len(path)] = path
        self._shorten(len(path), rng, attempts)

    def _shorten(self, count: int, rng: np.random.Generator, attempts: int) -> None:
        draws = rng.random((attempts, shortcut.DRAWS))
        self.best_cost = best_path.better(self._space.steps, self._hung, self._kept, count, draws, self.best_cost)

    def result(self, iterations: int = 0) -> Plan:
        """The best path, or the way towards the goal as far as it goes."""
        count = int(self._counts[grow.BEST])
        if count:
            path = self._space.to_odom(self._best[:count])
            return Plan(path=path, cost_m=length(path), iterations=iterations, solved=True)
        which, node = (OWN, int(self._counts[grow.NEAREST])) if self._pair is None else (FROM_START, self._near_goal())
        count = int(way_to(self._memory.nodes[which], self._memory.links[which], node, self._path))
        path = self._space.to_odom(self._path[: max(count, 1)])
        return Plan(path=path, cost_m=math.inf, iterations=iterations, solved=False)

    def edges(self) -> Array:
        """Node and parent (E, 2, 3), odom, m."""
        nodes, links, _ = self._tree
        hung = np.flatnonzero(links[: int(self._counts[grow.NODES]), PARENT] >= 0)
        return self._space.to_odom(np.stack([nodes[hung, :3], nodes[links[hung, PARENT], :3]], axis=1))

    def join(self, rng: np.random.Generator) -> bool:
        """One chunk of RRT-Connect; its first path is taken as it is, later ones if they are better once shortened."""
        memory, bucket = self._memory, self._bucket
        if self._pair is None:
            memory.plant(FROM_START, self.ends[:1], bucket)
            memory.plant(FROM_GOAL, self.ends[1:], bucket)
            self._pair = np.array([1, 1])
        draws = rng.random((self.config.chunk, two_trees.DRAWS))
        step = self.config.step_m / self._space.resolution_m
        count = two_trees.connect(
            self._space.steps, *memory.pair, self._pair, self._box, draws, step, bucket, self._path
        )
        if not count:
            return False
        self._pair = None
        if self.solved:
            self._shorten(count, rng, self.config.restart_shortcuts)
        else:
            count = drop_repeats(self._path, count)
            self.best_cost = best_path.take(self._hung, self._kept, count, self.best_cost)
        return True

    def _hang(self, path: Array) -> None:
        grow.add_chain(*self._tree, self._counts, self._bucket, np.ascontiguousarray(path))

    def _keep_if_better(self) -> None:
        self.best_cost = best_path.keep(self._hung, self._kept, self.best_cost)

    def _near_goal(self) -> int:
        """Node of the start's tree nearest to the goal."""
        assert self._pair is not None
        reached = self._memory.nodes[FROM_START, : self._pair[0], :3]
        return int(np.argmin(np.linalg.norm(reached - self.ends[1], axis=1)))

    def _settings(self) -> Array:
        """Numbers for `grow`; the neighbourhood shrinks with log(n)/n (Karaman and Frazzoli 2011)."""
        config, cell = self.config, self._space.resolution_m
        n = int(self._counts[grow.NODES])
        volume = float(self._space.steps.size)
        if self.best_cost < NEVER:
            c_min = float(np.linalg.norm(self.ends[1] - self.ends[0]))
            volume = min(volume, math.pi / 6.0 * self.best_cost * max(self.best_cost**2 - c_min**2, 1.0))
        gamma = config.radius_factor * 2.0 * (4.0 / 3.0 * volume / (4.0 / 3.0 * math.pi)) ** (1.0 / 3.0)
        radius = min(gamma * (math.log(n) / n) ** (1.0 / 3.0), config.step_m / cell)
        settings = np.zeros(6)
        settings[grow.STEP], settings[grow.RADIUS] = config.step_m / cell, radius
        settings[grow.GOAL_BIAS], settings[grow.LOCAL_SHARE] = config.goal_bias, config.local_share
        settings[grow.LOCAL_WIDTH], settings[grow.BUCKET] = config.local_width_m / cell, self._bucket
        return settings


def _axes(way: Array) -> Array:
    """Rotation (3, 3) whose first column points along `way`."""
    first = way / max(float(np.linalg.norm(way)), 1e-12)
    helper = np.eye(3)[int(np.argmin(np.abs(first)))]
    second = np.cross(first, helper)
    second /= np.linalg.norm(second)
    return np.column_stack([first, second, np.cross(first, second)])
