"""What every planner is asked and what it answers.

>>> plan = planner.plan(start, goal, space, rng=np.random.default_rng(1), iterations=1000)
>>> plan.solved, plan.cost_m, plan.path  # (N, 3), odom, m
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from companion.core.messages import Array
from companion.planning.space import Space

PlannerName = Literal[
    "portfolio", "rrt_star", "rrt", "rrt_connect", "prm", "prm_star", "dijkstra", "astar", "theta_star"
]
Proof = Literal["", "optimal", "infeasible"]


class CellSpace(Space, Protocol):
    """A space of cubic cells; positions in cells are measured from its corner and not rounded."""

    resolution_m: float
    steps: NDArray[np.uint8]
    """0: blocked; 1 + n: free, and a jump of n / JUMP_UNIT cells meets nothing blocked; (X, Y, Z)."""

    @property
    def sample_box(self) -> Array:
        """Corners (2, 3), in cells, of a box that holds all free places; flat in a plane world."""
        ...

    def to_cells(self, points: Array) -> Array:
        """odom m -> cells."""
        ...

    def to_odom(self, cells: Array) -> Array:
        """Cells -> odom m."""
        ...

    def contains(self, point: Array, *, margin_m: float = 0.0) -> bool:
        """Is the point inside, `margin_m` from the border?"""
        ...

    def path_free(self, path: Array) -> bool:
        """May the vehicle's centre follow the polyline (N, 3)?"""
        ...


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Plan:
    """What a planner found. Unsolved: the way to the reached place nearest to the goal."""

    path: Array  # (N, 3), odom, m
    cost_m: float  # length; infinite if unsolved
    iterations: int  # samples, or expanded nodes
    solved: bool
    proof: Proof = ""
    """`optimal`: no shorter way on the planner's lattice; `infeasible`: no way at the map's resolution."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Query:
    """What a search is asked, of ends that are free; the words are those of `Planner.plan`."""

    start: Array  # (3,), odom, m
    goal: Array  # (3,)
    space: CellSpace
    rng: np.random.Generator
    iterations: int
    known_path: Array | None = None  # (N, 3)


class Planner(ABC):
    """Finds ways; an answer depends on the arguments alone. Those of one kind differ in `search`."""

    straight_first: ClassVar[bool] = False
    """Whether a free straight way is answered without a search."""

    def plan(
        self,
        start: Array,
        goal: Array,
        space: CellSpace,
        *,
        rng: np.random.Generator,
        iterations: int,
        known_path: Array | None = None,
    ) -> Plan:
        """A way from `start` to `goal`, (3,) odom; ends that are not free give an unsolved plan.

        `iterations` bounds the samples; a search of a finite lattice ends by itself.
        `known_path` (N, 3) may help and need not be valid or fit the ends.
        """
        answer = (trivial if self.straight_first else refused)(start, goal, space)
        if answer is not None:
            return answer
        query = Query(start=start, goal=goal, space=space, rng=rng, iterations=iterations, known_path=known_path)
        return self.search(query)

    @abstractmethod
    def search(self, query: Query) -> Plan:
        """The planner's own way of finding one."""


def refused(start: Array, goal: Array, space: CellSpace) -> Plan | None:
    """The unsolved plan for ends that are not free or not inside; None: both are fine."""
    inside = space.contains(start) and space.contains(goal)
    if inside and bool(space.free(np.stack([start, goal])).all()):
        return None
    return Plan(path=start[None].copy(), cost_m=float("inf"), iterations=0, solved=False)


def trivial(start: Array, goal: Array, space: CellSpace) -> Plan | None:
    """The answer that needs no search: ends that are not free, or a free straight way; None: there is none."""
    refusal = refused(start, goal, space)
    if refusal is not None or not space.segment_free(start, goal):
        return refusal
    straight = np.stack([start, goal])
    return Plan(path=straight, cost_m=float(np.linalg.norm(goal - start)), iterations=0, solved=True, proof="optimal")
