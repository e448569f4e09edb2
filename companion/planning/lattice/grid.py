"""A grid of free and blocked cells to search in.

>>> lattice = Lattice(blocked, neighbours=8)
>>> found = lattice.search((0, 0), (9, 9), heuristic="octile")
>>> found.cost, found.expanded, found.cells  # (N, 2)
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from companion.core.errors import InputError
from companion.core.messages import Array
from companion.planning.lattice.heuristics import Heuristic, heuristic_code
from companion.planning.lattice.moves import PLANE, Corners, Neighbours, moves_of
from companion.planning.lattice.search import CLOSED, search, walk_back
from companion.planning.lattice.theta_star import chain, theta_star

_HERE = 2  # bit of a cell in its own place of `_blocked`
_MOST_CELLS = 2**31 - 1
MOST_WEIGHT = 5.0  # the ring of the open list holds no more

Cells = NDArray[np.int64]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Found:
    """What a search found; D is 2 or 3, as the grid.

    `cells` (N, D) lead from the start to the goal, or, if there is no way, to the reached cell nearest to it.
    """

    cells: Cells
    cost: float  # cells; infinite: there is no way
    expanded: int
    closed: Cells  # (K, D) the expanded cells

    @property
    def solved(self) -> bool:
        """Is there a way?"""
        return self.cost < math.inf


class Scratch:
    """Memory of searches, clean between them."""

    def __init__(self, cells: int) -> None:
        self.label = np.zeros(cells, np.uint8)
        self.cost = np.empty(cells)
        self.given = np.empty(cells, np.uint32)
        self.parent = np.empty(cells, np.int32)


class Lattice:
    """Free cells of `blocked` (X, Y) or (X, Y, Z), and the moves between neighbours."""

    def __init__(
        self,
        blocked: NDArray[Any],
        *,
        neighbours: Neighbours,
        corners: Corners = "keep",
        scratch: Scratch | None = None,
    ) -> None:
        self._dimensions = blocked.ndim
        if blocked.ndim == 2:
            if neighbours not in PLANE:
                raise InputError(f"{neighbours} neighbours need 3 dimensions", field="neighbours", valid="4, 8")
            blocked = blocked[:, :, None]
        padded = np.ones(np.array(blocked.shape) + 2, np.uint8)
        padded[1:-1, 1:-1, 1:-1] = blocked != 0
        if padded.size > _MOST_CELLS:
            raise InputError(f"{padded.size} cells are too many", field="blocked", valid=f"at most {_MOST_CELLS}")
        self.neighbours = neighbours
        self._shape = np.array(padded.shape, np.int64)
        self._strides = np.array([self._shape[1] * self._shape[2], self._shape[2], 1], np.int64)
        self._blocked = padded.ravel() << 1  # bits: blocked below, here, above
        self._blocked[1:] |= padded.ravel()[:-1]
        self._blocked[:-1] |= padded.ravel()[1:] << 2
        moves = moves_of(neighbours, corners)
        self._flat = (moves.offsets @ self._strides).astype(np.int64)
        self._moves = (self._flat, moves.offsets, moves.lengths, moves.needs, moves.natural)
        fits = scratch is not None and len(scratch.label) == padded.size
        self.scratch = scratch if scratch is not None and fits else Scratch(padded.size)

    def search(
        self,
        start: Sequence[int],
        goal: Sequence[int],
        *,
        heuristic: Heuristic = "octile",
        weight: float = 1.0,
        weighted: bool = False,
    ) -> Found:
        """A* from cell to cell; heuristic `none`: Dijkstra. The cost is the least, unless `weighted`.

        Raises InputError for a heuristic that may exceed the true way if `weighted` is false.
        """
        if not 0.0 <= weight <= MOST_WEIGHT:
            raise InputError(f"{weight:g} is out of range", field="weight", valid=f"0 to {MOST_WEIGHT:g}")
        code = heuristic_code(heuristic, self.neighbours, weight=weight, weighted=weighted)
        ends = self._ends(start, goal)
        if ends is None:
            return self._nothing(start)
        label, scratch = self.scratch.label, (self.scratch.label, self.scratch.cost, self.scratch.given)
        world = (self._blocked, self._shape, self._moves, ends, (code, weight, not weighted))
        cost, expanded, seen = search(*world, scratch)
        closed = seen[(label[seen] & CLOSED) > 0]
        if not label[ends[1]]:
            ends, cost = (ends[0], self._nearest(closed, ends[1])), math.inf
        nodes = walk_back(self._flat, ends, label)
        label[seen] = 0
        return Found(cells=self._cells(nodes), cost=cost, expanded=expanded, closed=self._cells(closed))

    def theta_star(
        self,
        start: Sequence[int],
        goal: Sequence[int],
        *,
        steps: NDArray[np.uint8],
        places: Array | None = None,
    ) -> Found:
        """Any-angle way; `cells` are its corners, in sight of each other.

        `steps` (X, Y, Z) of the space, 0 where `blocked`. `places` (2, 3): where in their cells, measured from the
        grid's corner, the way begins and ends; None: at the centres.
        """
        ends = self._ends(start, goal)
        if ends is None:
            return self._nothing(start)
        label, scratch = self.scratch.label, self.scratch
        if places is None:
            places = np.stack([self._centre(start), self._centre(goal)])
        world = (self._blocked, self._shape, self._moves, ends, places, steps)
        expanded, seen = theta_star(*world, label, scratch.cost, scratch.parent)
        closed = seen[(label[seen] & CLOSED) > 0]
        cost = float(scratch.cost[ends[1]]) if label[ends[1]] else math.inf
        if not label[ends[1]]:
            ends = (ends[0], self._nearest(closed, ends[1]))
        nodes = chain(scratch.parent, ends)
        label[seen] = 0
        return Found(cells=self._cells(nodes), cost=cost, expanded=expanded, closed=self._cells(closed))

    def _ends(self, start: Sequence[int], goal: Sequence[int]) -> tuple[int, int] | None:
        """Indices in the padded grid; None: one is blocked or outside."""
        places = np.zeros((2, 3), np.int64)
        places[:, : self._dimensions] = start, goal
        if np.any(places < 0) or np.any(places >= self._shape - 2):
            return None
        nodes = (places + 1) @ self._strides
        return None if (self._blocked[nodes] & _HERE).any() else (int(nodes[0]), int(nodes[1]))

    def _nothing(self, start: Sequence[int]) -> Found:
        none = np.empty((0, self._dimensions), np.int64)
        return Found(cells=np.array([start], np.int64), cost=math.inf, expanded=0, closed=none)

    def _nearest(self, nodes: NDArray[Any], goal: int) -> int:
        gaps = self._cells(nodes) - self._cells(np.array([goal]))
        return int(nodes[np.argmin(np.linalg.norm(gaps, axis=1))])

    def _cells(self, nodes: NDArray[Any]) -> Cells:
        where: Cells = np.column_stack(np.unravel_index(nodes, tuple(self._shape))) - 1
        return where[:, : self._dimensions]

    def _centre(self, cell: Sequence[int]) -> Array:
        centre = np.full(3, 0.5)
        centre[: self._dimensions] += cell
        return centre
