"""The textbook's exercise: A* on a grid of 10 x 10 cells with Manhattan's and Chebyshev's heuristic.

for answer in solve(): print(answer.picture, answer.cost, answer.expanded, answer.cpu_us)
print(comment(solve()))
"""

from __future__ import annotations

import time
from typing import Any, Literal

import msgspec
import numpy as np
from numpy.typing import NDArray

from companion.core.errors import InputError
from companion.planning.lattice.grid import Found, Lattice
from companion.planning.lattice.heuristics import Heuristic, admissible

GRID = """\
S.........
.......#..
..####.#..
.....#.#..
.....#.#..
.###.#.#..
...#.#.#..
...#...#..
...#####..
.........G
"""
_REPEATS = 200
_MOVES: tuple[Literal[4, 8], ...] = (4, 8)


class Answer(msgspec.Struct, frozen=True, kw_only=True):
    """What one heuristic did on the grid; rows and columns count from 0 at the upper left."""

    neighbours: int
    heuristic: Heuristic
    admissible: bool
    cost: float
    """Cells; infinite if there is no way."""
    optimum: float
    """Dijkstra's cost."""
    expanded: int
    dijkstra_expanded: int
    cpu_us: float
    path: list[tuple[int, int]]
    picture: str
    """`*` way, `+` expanded, `#` blocked."""


def solve(text: str = GRID, *, heuristics: tuple[Heuristic, ...] = ("manhattan", "chebyshev")) -> list[Answer]:
    """Each heuristic with 4 and with 8 neighbours (diagonals brush no blocked corner).

    Raises InputError if the text is no rectangle of `.` and `#` with one S and one G.
    """
    cells, start, goal = read_grid(text)
    answers = []
    for neighbours in _MOVES:
        lattice = Lattice(cells == "#", neighbours=neighbours)
        plain = lattice.search(start, goal, heuristic="none")
        for heuristic in heuristics:
            found, cpu_us = _timed(lattice, start, goal, heuristic)
            answers.append(
                Answer(
                    neighbours=neighbours,
                    heuristic=heuristic,
                    admissible=admissible(heuristic, neighbours),
                    cost=round(found.cost, 3),
                    optimum=round(plain.cost, 3),
                    expanded=found.expanded,
                    dijkstra_expanded=plain.expanded,
                    cpu_us=cpu_us,
                    path=[(int(i), int(j)) for i, j in found.cells],
                    picture=_picture(cells, found),
                )
            )
    return answers


def read_grid(text: str) -> tuple[NDArray[Any], tuple[int, int], tuple[int, int]]:
    """Characters (rows, columns), place of S, place of G."""
    rows = text.split()
    if not rows or len({len(row) for row in rows}) != 1 or set("".join(rows)) - set(".#SG"):
        raise InputError("not a rectangle of characters", field="grid", valid=". # S G")
    cells = np.array([list(row) for row in rows])
    ends = [np.argwhere(cells == letter) for letter in "SG"]
    if any(len(end) != 1 for end in ends):
        raise InputError("S and G must be there once each", field="grid", valid=". # S G")
    start, goal = ((int(end[0, 0]), int(end[0, 1])) for end in ends)
    return cells, start, goal


def _timed(lattice: Lattice, start: tuple[int, int], goal: tuple[int, int], h: Heuristic) -> tuple[Found, float]:
    """The answer, and the least CPU time of many, µs."""
    least = np.inf
    for _ in range(_REPEATS):
        began = time.process_time_ns()
        found = lattice.search(start, goal, heuristic=h, weighted=True)
        least = min(least, (time.process_time_ns() - began) * 1e-3)
    return found, round(least, 1)


def _picture(cells: NDArray[Any], found: Found) -> str:
    shown = cells.copy()
    for marked, letter in ((found.closed, "+"), (found.cells, "*")):
        for i, j in marked:
            if shown[i, j] in ".+":
                shown[i, j] = letter
    return "\n".join("".join(row) for row in shown)


def comment(answers: list[Answer]) -> str:
    """What the figures say, in words, one paragraph per set of neighbours."""
    pairs = ([a for a in answers if a.neighbours == n] for n in _MOVES)
    return "\n\n".join(_compared(*pair) for pair in pairs)


def _compared(a: Answer, b: Answer) -> str:
    few, many = (a, b) if a.expanded <= b.expanded else (b, a)
    where = f"With {a.neighbours} neighbours"
    if np.isinf(a.optimum):
        return f"{where} there is no way: both expand every cell in reach, {a.expanded}."
    if few.expanded == many.expanded:
        first = f"{where} both heuristics expand {few.expanded} cells (Dijkstra {few.dijkstra_expanded})."
    else:
        share = 100 * (1 - few.expanded / many.expanded)
        first = (
            f"{where} {few.heuristic} expands {few.expanded} cells, {many.heuristic} {many.expanded}: "
            f"{share:.0f} % fewer (Dijkstra {few.dijkstra_expanded})."
        )
    return f"{first} {_reason(a, b)} {_quality(a)} {_quality(b)} CPU {a.cpu_us:g} and {b.cpu_us:g} µs."


def _reason(a: Answer, b: Answer) -> str:
    """Both bounds from the start, against the true way: the nearer bound leaves less to expand."""
    bounds = {x.heuristic: _bound(x) for x in (a, b)}
    told = ", ".join(f"{name} {bound:g}" for name, bound in bounds.items())
    return f"From the start the way is {a.optimum:g} long; the bounds say {told}: the larger leads straighter."


def _bound(a: Answer) -> float:
    (i, j), (m, n) = a.path[0], a.path[-1]
    dx, dy = abs(i - m), abs(j - n)
    return float(dx + dy if a.heuristic == "manhattan" else max(dx, dy))


def _quality(a: Answer) -> str:
    name = a.heuristic.capitalize()
    if a.admissible:
        return f"{name} never exceeds the true way, and its way of {a.cost:g} is the shortest."
    why = f"{name} counts a diagonal as 2 instead of 1.41"
    if a.cost > a.optimum + 1e-6:
        return f"{why}: its way of {a.cost:g} is longer than the shortest, {a.optimum:g}."
    return f"{why} and may miss the shortest way; here its way of {a.cost:g} is the shortest."
