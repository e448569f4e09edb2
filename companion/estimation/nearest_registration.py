"""Registration of a scan against what is nearest to its points in a map, whatever that is: planes or lines."""

from __future__ import annotations

from abc import ABC, abstractmethod

import numpy as np

from companion.core.messages import Array
from companion.estimation.normal import Normal


class NearestRegistration(ABC):
    """Linearises one scan at one pose after another; what its points meet in a map is searched only when needed."""

    def __init__(self, points_body: Array, *, numbers: int, inflation: float, search_again_m: float) -> None:
        """`numbers`: of what a point meets, a row of `met`; rows that are not `valid` are multiplied, too."""
        self.points = points_body
        self.met = np.zeros((len(points_body), numbers))
        self.valid = np.zeros(len(points_body), np.bool_)
        self._inflation, self._search_again_m = inflation, search_again_m
        self._searched: tuple[Array, Array] | None = None

    @abstractmethod
    def find(self, R: Array, p: Array) -> None:
        """Fill `met` and `valid` for the pose (R_odom_body, p_odom)."""

    @abstractmethod
    def add(self, R: Array, p: Array, H: Array, g: Array) -> int:
        """Normal equations of what is met into H (6, 6) and g (6,); returns how many points were used."""

    @abstractmethod
    def off_m(self, R: Array, p: Array) -> Array:
        """Distances (N,) of the points from what they meet."""

    def linearise(self, R: Array, p: Array) -> Normal:
        """Normal equations at the pose (R_odom_body, p_odom)."""
        if self._is_stale(R, p):
            self._search(R, p)
        H, g = np.empty((6, 6)), np.empty(6)
        used = self.add(R, p, H, g)
        return Normal(R.copy(), p.copy(), H / self._inflation, g / self._inflation, used, len(self.points))

    def fits(self, R: Array, p: Array, distance_m: float) -> tuple[int, int, int]:
        """How many points lie within a distance of what they meet, searched anew, how many meet any, and all."""
        self._search(R, p)
        near = self.valid & (self.off_m(R, p) < distance_m)
        return int(near.sum()), int(self.valid.sum()), len(self.points)

    def _search(self, R: Array, p: Array) -> None:
        self.find(R, p)
        self._searched = (R.copy(), p.copy())

    def _is_stale(self, R: Array, p: Array) -> bool:
        if self._searched is None:
            return True
        moved = np.linalg.norm(p - self._searched[1]) + 3.0 * np.linalg.norm(R - self._searched[0])
        return bool(moved > self._search_again_m)
