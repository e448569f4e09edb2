"""The rays of one scan, cast into one grid of bits, or half of them by another thread into another."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np
from numba import njit

from companion.core.messages import Array, Array32
from companion.mapping.rays import RayGrid, ToGrid

MapPool = Callable[[Callable[[Any], Any], Iterable[Any]], Iterable[Any]]
"""As `concurrent.futures.Executor.map` or the builtin `map`: results in the order of the items."""
Cast = tuple[Array32, ToGrid, tuple[float, float, bool]]
"""What `RayGrid.cast` takes: vectors, pose, ranges."""
_Job = tuple[RayGrid, list[Cast]]


class ScanRays:
    """`grid` ends with the bits of all rays: which grid a ray went into does not change them."""

    def __init__(self, resolution_m: float, range_m: float, pool: MapPool | None) -> None:
        """`pool` runs two jobs at once if it can; None: there is but one."""
        self.grid = RayGrid(resolution_m, range_m)
        self._other = None if pool is None else RayGrid(resolution_m, range_m)
        self._pool: MapPool = pool or map

    def place(self, origin_odom: Array) -> None:
        """Centre the empty grids on the sensor (3,), m."""
        self.grid.place(origin_odom)
        if self._other is not None:
            self._other.place(origin_odom)

    def cast(self, casts: Sequence[Cast]) -> tuple[list[int], int]:
        """Rays used (len(casts),) of each cast, and voxel steps of all."""
        results = list(self._pool(_run, self._jobs(casts)))
        if self._other is not None:
            absorb(self.grid, self._other)
        used = np.sum([[count for count, _ in parts] for parts in results], axis=0)
        return used.tolist(), sum(steps for parts in results for _, steps in parts)

    def _jobs(self, casts: Sequence[Cast]) -> list[_Job]:
        if self._other is None:
            return [(self.grid, list(casts))]
        first = [(vectors[: len(vectors) // 2], pose, ranges) for vectors, pose, ranges in casts]
        second = [(vectors[len(vectors) // 2 :], pose, ranges) for vectors, pose, ranges in casts]
        return [(self.grid, first), (self._other, second)]


def absorb(grid: RayGrid, other: RayGrid) -> None:
    """Add the bits of `other`, at the same place, to those of `grid`; `other` is empty then."""
    grid.make_room(other.hit_blocks)
    _absorb(other.met(), grid.bits, other.bits, grid.hit_count)
    grid.stretch(other)
    other.cleared()


def _run(job: _Job) -> list[tuple[int, int]]:
    grid, casts = job
    return [grid.cast(*cast) for cast in casts]


@njit(cache=True, nogil=True)
def _absorb(met, bits, others, hit_count):  # type: ignore[no-untyped-def]
    (free, hit, hit_of), (free2, hit2, hit_of2) = bits, others
    for number in met:
        for w in range(free.shape[1]):
            free[number, w] |= free2[number, w]
            free2[number, w] = 0
        struck = hit_of2[number]
        if struck != 0:
            if hit_of[number] == 0:
                hit_count[0] += 1
                hit_of[number] = hit_count[0]
            for w in range(hit.shape[1]):
                hit[hit_of[number], w] |= hit2[struck, w]
                hit2[struck, w] = 0
            hit_of2[number] = 0
