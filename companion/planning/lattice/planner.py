"""Dijkstra, A* and Theta* as planners in a space of cells.

>>> plan = AStar(LatticeConfig()).plan(start, goal, space, rng=np.random.default_rng(0), iterations=0)
"""

from __future__ import annotations

import math
from typing import Annotated

import msgspec
import numpy as np

from companion.core.messages import Array
from companion.planning.lattice.grid import MOST_WEIGHT, Found, Lattice, Scratch
from companion.planning.lattice.heuristics import Heuristic, admissible, heuristic_code
from companion.planning.lattice.moves import Neighbours
from companion.planning.planner import CellSpace, Plan, Planner, Proof, Query
from companion.planning.polyline import length


class LatticeConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """How Dijkstra, A* and Theta* search the cells."""

    neighbours: Neighbours = 26
    """Moves of a cell; 4 and 8 stay in the layer of the start."""
    heuristic: Heuristic = "octile"
    """A*'s lower bound of the way that is left; `manhattan` fits 4 and 6 neighbours alone."""
    weight: Annotated[float, msgspec.Meta(ge=0, le=MOST_WEIGHT)] = 1.0
    """Times the bound; above 1 A* is faster and the way longer by at most this factor."""
    weighted: bool = False
    """Accept a bound that may exceed the true way; without it such settings are refused."""


class AStar(Planner):
    """The shortest way along neighbouring cells, from centre to centre but for the ends.

    Raises InputError for a heuristic that does not fit the neighbours.
    """

    def __init__(self, config: LatticeConfig) -> None:
        weighted = config.weighted
        heuristic_code(
            config.heuristic, config.neighbours, weight=config.weight, weighted=weighted
        )  # before the flight
        self.config = config
        self._scratch: Scratch | None = None
        self.closed = np.empty((0, 3), np.int64)
        """Expanded cells (K, 3) of the last plan: for pictures."""

    def search(self, query: Query) -> Plan:
        """Ends by itself: `iterations`, `rng` and `known_path` change nothing. Plan.iterations are expansions."""
        start, goal, space = query.start, query.goal, query.space
        places = space.to_cells(np.stack([start, goal]))
        lattice = self._lattice(space)
        found = self._search(lattice, places, space)
        self.closed = found.closed
        path = space.to_odom(found.cells.astype(np.float64) + 0.5)
        path[0] = start
        if found.solved:
            path = np.vstack([path[: max(len(path) - 1, 1)], goal])
        return Plan(
            path=path,
            cost_m=length(path) if found.solved else math.inf,
            iterations=found.expanded,
            solved=found.solved,
            proof=self._proof(found),
        )

    def _lattice(self, space: CellSpace) -> Lattice:
        lattice = Lattice(space.steps == 0, neighbours=self.config.neighbours, scratch=self._scratch)
        self._scratch = lattice.scratch
        return lattice

    def _search(self, lattice: Lattice, places: Array, space: CellSpace) -> Found:
        config = self.config
        start, goal = np.floor(places).astype(int).tolist()
        return lattice.search(start, goal, heuristic=config.heuristic, weight=config.weight, weighted=config.weighted)

    def _proof(self, found: Found) -> Proof:
        """A plane search knows its layer alone, a weighted one may miss the shortest way."""
        config = self.config
        if not found.solved:
            return "infeasible" if config.neighbours in (6, 18, 26) else ""
        exact = config.weight <= 1.0 and admissible(config.heuristic, config.neighbours)
        return "optimal" if exact else ""


class Dijkstra(AStar):
    """A* without a heuristic."""

    def __init__(self, config: LatticeConfig) -> None:
        super().__init__(msgspec.structs.replace(config, heuristic="none", weight=1.0))


class ThetaStar(AStar):
    """Any-angle ways; much shorter than A*'s, not proven shortest. The heuristic is the straight distance."""

    def _search(self, lattice: Lattice, places: Array, space: CellSpace) -> Found:
        start, goal = np.floor(places).astype(int).tolist()
        return lattice.theta_star(start, goal, steps=space.steps, places=places)

    def _proof(self, found: Found) -> Proof:
        return "" if found.solved else super()._proof(found)
