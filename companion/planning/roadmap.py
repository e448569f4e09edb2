"""Probabilistic roadmaps: PRM with k nearest neighbours (Kavraki et al. 1996), PRM* (Karaman and Frazzoli 2011).

A roadmap is built once for a map, kept with it, and asked many times:

>>> roadmap = build_roadmap(space, rng=np.random.default_rng(1), samples=2000, config=RoadmapConfig(), star=True)
>>> roadmap = Roadmap.from_bytes(roadmap.to_bytes())
>>> plan = roadmap.query(start, goal, space)
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Annotated

import msgspec
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from companion.core.messages import Array
from companion.planning.planner import CellSpace, Plan, Planner, Query, refused
from companion.planning.polyline import length, without_repeats
from companion.planning.roadmap_bytes import pack, unpack
from companion.planning.roadmap_search import links_free, pairs_free, route, way_back

_MOST_REPAIRS = 200  # edges that the map has closed since, per query


class RoadmapConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """How the roadmaps of PRM and PRM* are joined."""

    neighbours: Annotated[int, msgspec.Meta(ge=1)] = 15
    """PRM: each sample is joined to this many nearest ones."""
    radius_factor: Annotated[float, msgspec.Meta(ge=1)] = 1.1
    """PRM*: radius over the least one with proven convergence."""
    links: Annotated[int, msgspec.Meta(ge=1)] = 30
    """Nearest samples that start and goal try to reach."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Roadmap:
    """N free places, and from each the places that it sees: `after[first[n] : first[n + 1]]`, both ways."""

    points: Array  # (N, 3), odom, m
    first: NDArray[np.int32]  # (N + 1,)
    after: NDArray[np.int32]  # (E,)
    links: int  # nearest places that start and goal try to reach

    def to_bytes(self) -> bytes:
        """The same roadmap gives the same bytes."""
        return pack(self.points, self.first, self.after, self.links)

    @classmethod
    def from_bytes(cls, data: bytes) -> Roadmap:
        """Raises InputError if the bytes are not a whole roadmap."""
        points, first, after, links = unpack(data)
        return cls(points=points, first=first, after=after, links=links)

    def query(self, start: Array, goal: Array, space: CellSpace) -> Plan:
        """Shortest way along the roadmap; `start`, `goal` (3,) odom. Plan.iterations are expanded places.

        Edges on the way that the map has closed since are left out (Bohlin and Kavraki 2000).
        """
        refusal = refused(start, goal, space)
        if refusal is not None:
            return refusal
        if space.segment_free(start, goal):
            straight = np.stack([start, goal])
            return Plan(path=straight, cost_m=length(straight), iterations=0, solved=True)
        to_ends = self._links(start, space), self._links(goal, space)
        open_ = np.ones(len(self.after), np.bool_)
        expanded = 0
        for _ in range(_MOST_REPAIRS):
            cost, parent, last, count = route(self.points, self.first, self.after, open_, *to_ends, goal)
            expanded += count
            nodes = way_back(parent, last)
            if self._close_what_is_blocked(nodes, open_, space):
                continue
            path = np.vstack([start, self.points[nodes], *([goal] if cost < math.inf else [])])
            path = without_repeats(path)
            cost_m = length(path) if cost < math.inf else math.inf
            return Plan(path=path, cost_m=cost_m, iterations=expanded, solved=cost < math.inf)
        return Plan(path=start[None].copy(), cost_m=math.inf, iterations=expanded, solved=False)

    def _links(self, end: Array, space: CellSpace) -> Array:
        """Distance (N,) to the nearest places in sight; infinite to all others."""
        gaps = np.linalg.norm(self.points - end, axis=1)
        near = np.argsort(gaps, kind="stable")[: self.links]
        seen = links_free(space.steps, space.to_cells(end), space.to_cells(self.points[near]))
        answer = np.full(len(gaps), math.inf)
        answer[near[seen]] = gaps[near[seen]]
        return answer

    def _close_what_is_blocked(self, nodes: NDArray[np.int64], open_: NDArray[np.bool_], space: CellSpace) -> bool:
        """Take blocked edges of a way out of use, both directions; was there one?"""
        pairs = np.column_stack([nodes[:-1], nodes[1:]])
        blocked = pairs[~pairs_free(space.steps, space.to_cells(self.points), pairs)]
        for a, b in [*blocked, *blocked[:, ::-1]]:
            edges = slice(self.first[a], self.first[a + 1])
            open_[edges] &= self.after[edges] != b
        return len(blocked) > 0


def build_roadmap(
    space: CellSpace,
    *,
    rng: np.random.Generator,
    samples: int,
    config: RoadmapConfig,
    star: bool,
    more: Array | None = None,
) -> Roadmap:
    """Uniform samples of the free space and all free edges between neighbours; `more` (K, 3) places are added.

    PRM joins the k nearest. PRM* (`star`) joins all within the radius that shrinks with (log n / n)^(1/d), by which
    the cost converges to the least.
    """
    points = _free_places(space, rng, samples)
    if more is not None and len(more):
        points = np.vstack([points, more[space.free(more)]])
    if star:
        pairs = _pairs_within(points, star_radius_m(space, len(points), config.radius_factor))
    else:
        pairs = _nearest_pairs(points, config.neighbours)
    pairs = pairs[pairs_free(space.steps, space.to_cells(points), pairs)]
    both = np.vstack([pairs, pairs[:, ::-1]])
    both = both[np.lexsort((both[:, 1], both[:, 0]))]
    first = np.searchsorted(both[:, 0], np.arange(len(points) + 1)).astype(np.int32)
    return Roadmap(points=points, first=first, after=both[:, 1].astype(np.int32), links=config.links)


def _free_places(space: CellSpace, rng: np.random.Generator, count: int) -> Array:
    """Uniform places (count, 3) in the free cells, odom, m; in a plane world in its plane."""
    free = np.flatnonzero(space.steps)
    if not len(free):
        return np.empty((0, 3))
    draws = rng.random((count, 4))
    which = free[np.minimum((draws[:, 0] * len(free)).astype(np.int64), len(free) - 1)]
    cells = np.column_stack(np.unravel_index(which, space.steps.shape)) + draws[:, 1:]
    low, high = space.sample_box
    return space.to_odom(np.where(low == high, low, cells))


def star_radius_m(space: CellSpace, count: int, factor: float) -> float:
    """PRM*'s radius for n = `count` places in the space.

    factor x 2 (1 + 1/d)^(1/d) (free volume / volume of the unit ball)^(1/d) (log n / n)^(1/d)
    """
    d = 2 if space.sample_box[0, 2] == space.sample_box[1, 2] else 3
    ball = math.pi if d == 2 else 4.0 / 3.0 * math.pi
    volume = float(np.count_nonzero(space.steps)) * space.resolution_m**d
    gamma = 2.0 * (1.0 + 1.0 / d) ** (1.0 / d) * (volume / ball) ** (1.0 / d)
    return factor * float(gamma * (math.log(max(count, 2)) / max(count, 2)) ** (1.0 / d))


def _pairs_within(points: Array, radius_m: float) -> NDArray[np.int64]:
    """Pairs (E, 2) that are at most a radius apart, the lower number first."""
    if len(points) < 2:
        return np.empty((0, 2), np.int64)
    pairs: NDArray[np.int64] = cKDTree(points).query_pairs(radius_m, output_type="ndarray")
    return pairs


def _nearest_pairs(points: Array, neighbours: int) -> NDArray[np.int64]:
    """Pairs (E, 2) of each point and its nearest, each once, the lower number first."""
    count = min(neighbours, len(points) - 1)
    if count < 1:
        return np.empty((0, 2), np.int64)
    near = cKDTree(points).query(points, k=count + 1)[1]
    own = np.repeat(np.arange(len(points)), count + 1)
    pairs = np.sort(np.column_stack([own, near.ravel()]), axis=1)
    different: NDArray[np.int64] = np.unique(pairs[pairs[:, 0] != pairs[:, 1]], axis=0)
    return different


class PRM(Planner):
    """Builds a roadmap of `iterations` samples for each plan: the map of a flight is a new one each time."""

    straight_first = True
    star = False

    def __init__(self, config: RoadmapConfig) -> None:
        self.config = config
        self.roadmap: Roadmap | None = None
        """Of the last plan."""

    def search(self, query: Query) -> Plan:
        """Shortest way along the roadmap; the points of `known_path` are places of it, too."""
        self.roadmap = build_roadmap(
            query.space,
            rng=query.rng,
            samples=query.iterations,
            config=self.config,
            star=self.star,
            more=query.known_path,
        )
        return replace(self.roadmap.query(query.start, query.goal, query.space), iterations=query.iterations)


class PRMStar(PRM):
    """PRM with the radius by which its cost converges to the least."""

    star = True
