"""Walkers in front of what rays met in the mesh."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from companion.core.messages import Array, Array32
from sim.world.walkers import Walkers, nearest_walker


class WalkerRays:
    """Tells how far a walker is along each ray, and puts it in front of what it hides.

    `mark` is what stands for a walker where else the number of a triangle does.
    """

    def __init__(self, walkers: Walkers, mark: int) -> None:
        self._tables, self._mark = walkers.tables(), mark

    def distances(self, rays: Array32, times_s: Array) -> Array32 | None:
        """To the first walker along rays (N, 6), each at its own time (N,); inf: none. None: nobody walks here."""
        if not len(self._tables[1]):
            return None
        far = np.empty(len(rays), np.float32)
        _meet(self._tables, rays, times_s, far)
        return far

    def cover(self, ranges: Array32, triangles: NDArray[np.uint32], walkers_m: Array32 | None) -> None:
        """Where walkers are nearer than the ranges (N,), put them there, in place."""
        if walkers_m is not None:
            nearer = walkers_m < ranges
            ranges[nearer], triangles[nearer] = walkers_m[nearer], self._mark

    def cover_picture(
        self, view: tuple[Array32, Array, Array], time_s: float, depth: Array32, triangles: NDArray[np.uint32]
    ) -> None:
        """The same for pixels (H, W); `view` is directions (H, W, 3) 1 long along the optical axis, R, p."""
        if len(self._tables[1]):
            _draw_over(self._tables, view, time_s, depth, triangles, np.uint32(self._mark))


@njit(cache=True, nogil=True)
def _meet(walkers, rays, times_s, far):  # type: ignore[no-untyped-def]
    for n in range(rays.shape[0]):
        far[n] = nearest_walker(walkers, rays[n], times_s[n], np.inf)


@njit(cache=True, nogil=True)
def _draw_over(walkers, view, time_s, depth, triangles, mark):  # type: ignore[no-untyped-def]
    dirs, R, p = view
    ray = np.empty(6)
    ray[:3] = p
    for i in range(depth.shape[0]):
        for j in range(depth.shape[1]):
            for c in range(3):
                ray[3 + c] = R[c, 0] * dirs[i, j, 0] + R[c, 1] * dirs[i, j, 1] + R[c, 2]
            far = nearest_walker(walkers, ray, time_s, np.float64(depth[i, j]))
            if far < depth[i, j]:
                depth[i, j], triangles[i, j] = far, mark
