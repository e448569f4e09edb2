"""Lower bounds of the way that is left, in cells. `none` makes A* Dijkstra's algorithm (1959).

A bound that never exceeds the true way is admissible; one that falls by at most the length of each move is
consistent, too. All are consistent on every lattice here, but Manhattan's with diagonal moves: |dx| + |dy| of one
diagonal is 2, its length 1.41.
"""

from __future__ import annotations

import math
from typing import Literal, get_args

from numba import njit

from companion.core.errors import InputError

Heuristic = Literal["none", "manhattan", "chebyshev", "euclidean", "octile"]
HEURISTICS: tuple[Heuristic, ...] = get_args(Heuristic)
NONE, MANHATTAN, CHEBYSHEV, EUCLIDEAN, OCTILE = range(5)
_SQRT2, _SQRT3 = math.sqrt(2.0), math.sqrt(3.0)


def admissible(heuristic: str, neighbours: int) -> bool:
    """Does it never exceed the true way?"""
    return heuristic != "manhattan" or neighbours in (4, 6)


def heuristic_code(heuristic: str, neighbours: int, *, weight: float, weighted: bool) -> int:
    """Number of a heuristic for the kernels.

    Raises InputError if the name is unknown, or if the heuristic times its weight may exceed the true way and
    `weighted` does not say that a longer way is accepted.
    """
    if heuristic not in HEURISTICS:
        raise InputError(f"{heuristic!r} is no heuristic", field="heuristic", valid=", ".join(HEURISTICS))
    if not weighted and (weight > 1.0 or not admissible(heuristic, neighbours)):
        fit = ", ".join(h for h in HEURISTICS if admissible(h, neighbours))
        what = f"{weight:g} x {heuristic} with {neighbours} neighbours may exceed the true way"
        raise InputError(f"{what}; weighted=true accepts a longer way", field="heuristic", valid=fit)
    return HEURISTICS.index(heuristic)


@njit(cache=True, nogil=True)
def estimate(kind, dx, dy, dz):  # type: ignore[no-untyped-def]
    """Bound for a goal that is dx, dy, dz >= 0 cells away along the axes."""
    if kind == NONE:
        return 0.0
    if kind == MANHATTAN:
        return dx + dy + dz
    if kind == EUCLIDEAN:
        return math.sqrt(dx * dx + dy * dy + dz * dz)
    most, least = max(dx, dy, dz), min(dx, dy, dz)
    if kind == CHEBYSHEV:
        return most
    middle = dx + dy + dz - most - least
    return most + (_SQRT2 - 1.0) * middle + (_SQRT3 - _SQRT2) * least
