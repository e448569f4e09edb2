"""Where in a map a view could have been taken: every place and heading is tried, points that hit are counted.

What is compared is the view with what is there, not with what a vehicle would see from there: a panorama asks that
one sees the same, so it errs where something hides something, or half a metre beside the place where it was made.
Source: E. Olson, "Real-Time Correlative Scan Matching", ICRA 2009, its coarse level, over all places of a map.
"""

from __future__ import annotations

import math
from typing import Annotated

import msgspec
import numpy as np
from numba import njit
from numpy.typing import NDArray

from companion.core.messages import Array, Array32
from companion.estimation.downsample import Thinner
from companion.estimation.places.views import Sight

Positive = Annotated[float, msgspec.Meta(gt=0)]
Count = Annotated[int, msgspec.Meta(ge=1)]
_MOST_CELLS = 1 << 26  # of one byte


class LikeliestConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """How coarsely places are tried, and how many are worth a closer look."""

    cell_m: Positive = 0.4  # a point hits if the map has one in its cell or in one of the six beside it
    reach_m: Positive = 16.0  # of the view about the eye
    thin_m: Positive = 0.6  # of the view
    points: Annotated[int, msgspec.Meta(ge=20)] = 150
    turns: Annotated[int, msgspec.Meta(ge=12, le=720)] = 90
    most_places: Count = 24
    elsewhere_m: Positive = 1.2  # places nearer to each other count as one


class CoarseMap:
    """Cells of points (N, 3), m, and of their neighbours, one byte each; in a huge map they are larger than asked for.

    >>> CoarseMap(points_map, LikeliestConfig()).likeliest(eyes, points_view)
    """

    def __init__(self, points: Array32, config: LikeliestConfig) -> None:
        self.config, self.cell_m = config, config.cell_m
        low, high = points.min(axis=0).astype(np.float64), points.max(axis=0).astype(np.float64)
        while float(np.prod((high - low) / self.cell_m + 4.0)) > _MOST_CELLS:
            self.cell_m *= 2.0
        self._corner = low - 1.5 * self.cell_m
        shape = np.floor((high - self._corner) / self.cell_m).astype(np.int64) + 2
        self._cells = np.zeros(shape, np.uint8)
        at = np.unique(np.floor((points - self._corner) / self.cell_m).astype(np.int64), axis=0)
        for step in ((0, 0, 0), (1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1)):
            self._cells[tuple((at + step).T)] = 1

    def likeliest(self, eyes: Array, view: Array32) -> list[Sight]:
        """Of `eyes` (M, 3), m, those at which most points of a levelled view (N, 3) about its eye hit, best first.

        `Sight.unlike` is the share that does not.
        """
        c = self.config
        near = view[np.einsum("ij,ij->i", view, view) < c.reach_m**2]
        points = Thinner().centroids(near, c.thin_m, at_most=c.points)
        if not len(points) or not len(eyes):
            return []
        hits, turn = np.full(len(eyes), -1, np.int64), np.zeros(len(eyes), np.int64)
        places = (np.ascontiguousarray(eyes, np.float64) - self._corner) / self.cell_m
        _try_all(self._cells, points / self.cell_m, places, c.turns, hits, turn)
        return self._apart(eyes, hits / len(points), turn)

    def _apart(self, eyes: Array, share: Array, turn: NDArray[np.int64]) -> list[Sight]:
        found: list[Sight] = []
        for n in np.argsort(-share, kind="stable"):
            if len(found) == self.config.most_places:
                break
            if all(np.linalg.norm(s.p_map - eyes[n]) >= self.config.elsewhere_m for s in found):
                yaw = math.remainder(2.0 * math.pi * turn[n] / self.config.turns, 2.0 * math.pi)
                found.append(Sight(eyes[n], yaw, float(1.0 - share[n])))
        return found


@njit(cache=True, nogil=True)
def _try_all(cells, points, places, turns, hits, turn):  # type: ignore[no-untyped-def]
    """Best turn of the points at each place, in cells; one that cannot be the best of its place is given up."""
    count = points.shape[0]
    turned = np.empty_like(points)
    for t in range(turns):
        yaw = 2.0 * math.pi * t / turns
        c, s = math.cos(yaw), math.sin(yaw)
        for n in range(count):
            turned[n, 0] = c * points[n, 0] - s * points[n, 1]
            turned[n, 1] = s * points[n, 0] + c * points[n, 1]
            turned[n, 2] = points[n, 2]
        for m in range(places.shape[0]):
            x, y, z = places[m]
            met, most = 0, hits[m]
            for n in range(count):
                if met + count - n <= most:
                    break
                i = math.floor(turned[n, 0] + x)
                j = math.floor(turned[n, 1] + y)
                k = math.floor(turned[n, 2] + z)
                if 0 <= i < cells.shape[0] and 0 <= j < cells.shape[1] and 0 <= k < cells.shape[2]:
                    met += cells[i, j, k]
            if met > most:
                hits[m], turn[m] = met, t
