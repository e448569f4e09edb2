"""Which moves a cell has, how long they are, and which cells they need free.

4 and 8 neighbours lie in the plane of a cell; 6, 18 and 26 are those that share a face, also an edge, also a corner.
With corners `keep` a diagonal move needs every cell of the box that it spans, so nothing is brushed; with `cut` it
needs the cell it enters alone.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from companion.core.errors import InputError
from companion.core.messages import Array

Neighbours = Literal[4, 8, 6, 18, 26]
Corners = Literal["keep", "cut"]
_AXES_MOVED = {4: 1, 8: 2, 6: 1, 18: 2, 26: 3}  # at most, per move
PLANE = (4, 8)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Moves:
    """M moves; bit 9 (a + 1) + 3 (b + 1) + (c + 1) of a need stands for the cell at offset (a, b, c)."""

    offsets: NDArray[np.int32]  # (M, 3)
    lengths: Array  # (M,), cells
    needs: NDArray[np.uint32]  # (M,) bit sets of cells that must be free
    natural: NDArray[np.uint32]  # (M + 1,) bit sets of moves that may follow each; the last: after none, at the start


def moves_of(neighbours: int, corners: str) -> Moves:
    """The moves in a fixed order; raises InputError that gives the valid choices."""
    if neighbours not in _AXES_MOVED:
        raise InputError(f"{neighbours} is no set of neighbours", field="neighbours", valid="4, 8, 6, 18, 26")
    if corners not in get_args(Corners):
        raise InputError(f"{corners!r} is no rule", field="corners", valid="keep, cut")
    reach = range(-1, 2)
    around = itertools.product(reach, reach, (0,) if neighbours in PLANE else reach)
    moves = [m for m in around if 0 < sum(map(abs, m)) <= _AXES_MOVED[neighbours]]
    return Moves(
        offsets=np.array(moves, np.int32),
        lengths=np.array([math.sqrt(sum(map(abs, m))) for m in moves]),
        needs=np.array([_need(m) if corners == "keep" else _bit(m) for m in moves], np.uint32),
        natural=np.array([*_natural(moves, neighbours), 2 ** len(moves) - 1], np.uint32),
    )


def _natural(moves: list[tuple[int, int, int]], neighbours: int) -> list[int]:
    """Moves that need to follow a move in open space, for of all equally long ways one order is enough.

    The order is: diagonals before straight moves (8 and 26), or along x before y before z (4 and 6). Any other
    follower has an equally long or shorter way around, through the cells next to the one between. After Harabor and
    Grastien 2011, and Sturtevant and Rabin 2016. With 18 neighbours several orders are equally long: all may follow.
    """
    if neighbours == 18:
        return [2 ** len(moves) - 1] * len(moves)
    follows = _follows_diagonal if neighbours in (8, 26) else _follows_straight
    return [sum(1 << n for n, after in enumerate(moves) if follows(before, after)) for before in moves]


def _follows_diagonal(before: tuple[int, int, int], after: tuple[int, int, int]) -> bool:
    """Every axis that moves goes on as before."""
    return all(a in (0, b) for a, b in zip(after, before, strict=True))


def _follows_straight(before: tuple[int, int, int], after: tuple[int, int, int]) -> bool:
    """On along the same axis, or to a later one."""
    axis, next_axis = (int(np.flatnonzero(move)[0]) for move in (before, after))
    return after == before or next_axis > axis


def _need(move: tuple[int, ...]) -> int:
    """All cells of the box that a move spans, but the one it leaves."""
    box = itertools.product(*((0, step) if step else (0,) for step in move))
    return sum(_bit(cell) for cell in box if any(cell))


def _bit(cell: tuple[int, ...]) -> int:
    a, b, c = cell
    return 1 << (9 * (a + 1) + 3 * (b + 1) + (c + 1))
