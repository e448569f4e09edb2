"""A saved map as a likelihood field: how far a place is from the nearest thing that is known to stand there.

Source: S. Thrun et al., "Probabilistic Robotics", 2005, sec. 6.4. The field may be a plan (2D,
height does not count) or a space (3D).
"""

from __future__ import annotations

import math
from typing import Annotated

import msgspec
import numpy as np
from numba import njit
from scipy import ndimage

from companion.core.errors import InputError
from companion.core.messages import Array, Array32

Positive = Annotated[float, msgspec.Meta(gt=0)]
Share = Annotated[float, msgspec.Meta(gt=0, lt=1)]


class FieldModel(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """What is expected of a point that was seen."""

    sigma_m: Positive = 0.1  # of a point about what is known: range noise, map cells, pose of the scan
    chance: Share = 0.05  # of a point that the map cannot explain
    independent: Positive = 15.0  # points that tell as much as all of a scan's, whose errors go together


class PriorMap:
    """Truncated distances (m) on a grid over known points (N, 2) or (N, 3), m; beyond it `reach_m`.

    >>> plan = PriorMap(walls, cell_m=0.1, reach_m=1.0)
    >>> plan.distance(np.array([[1.0, 2.0, 0.0]]))
    """

    def __init__(self, known: Array, *, cell_m: float, reach_m: float) -> None:
        if known.ndim != 2 or known.shape[1] not in (2, 3) or len(known) == 0:
            raise InputError(f"shape {known.shape}", field="known", valid="(N, 2) or (N, 3), N > 0")
        self.cell_m, self.reach_m, self.axes = cell_m, reach_m, known.shape[1]
        corner = known.min(axis=0) - reach_m - cell_m
        size = np.ceil((np.ptp(known, axis=0) + 2.0 * (reach_m + cell_m)) / cell_m).astype(int) + 1
        free = np.ones(tuple(size.tolist()), bool)
        free[tuple(np.floor((known - corner) / cell_m).astype(int).T)] = False
        gap_m = np.minimum(ndimage.distance_transform_edt(free) * cell_m, reach_m).astype(np.float32)
        self.field: Array32 = gap_m if self.axes == 3 else gap_m[:, :, None]
        self.corner = np.append(corner, 0.0) if self.axes == 2 else corner

    def log_likelihood(self, model: FieldModel) -> Array32:
        """Of a seen point, per cell; that of a place beyond the field is log(chance)."""
        fit = np.exp(-0.5 * (self.field / model.sigma_m) ** 2)
        table: Array32 = np.log((1.0 - model.chance) * fit + model.chance).astype(np.float32)
        return table

    def distance(self, points: Array) -> Array:
        """Metres to what is known (N,), of points (N, 3), linear between cell centres."""
        return self.distance_and_gradient(points)[0]

    def distance_and_gradient(self, points: Array) -> tuple[Array, Array]:
        """Metres (N,) and their exact derivative (N, 3); zero gradient beyond the field."""
        distance, gradient = np.empty(len(points)), np.empty((len(points), 3))
        _interpolate(self.field, self.corner, self.cell_m, self.reach_m, points, distance, gradient)
        return distance, gradient


@njit(cache=True, nogil=True)
def _interpolate(field, corner, cell, reach, points, distance, gradient):  # type: ignore[no-untyped-def]
    nx, ny, nz = field.shape
    flat = nz == 1
    for n in range(points.shape[0]):
        gradient[n, 0], gradient[n, 1], gradient[n, 2] = 0.0, 0.0, 0.0
        u = (points[n, 0] - corner[0]) / cell - 0.5
        v = (points[n, 1] - corner[1]) / cell - 0.5
        w = 0.0 if flat else (points[n, 2] - corner[2]) / cell - 0.5
        i, j, k = np.int64(math.floor(u)), np.int64(math.floor(v)), np.int64(math.floor(w))
        if i < 0 or j < 0 or k < 0 or i + 1 >= nx or j + 1 >= ny or (k + 1 >= nz and not flat):
            distance[n] = reach
            continue
        a, b, c = u - i, v - j, w - k
        top = k if flat else k + 1
        total = 0.0
        for di in range(2):
            wx = a if di else 1.0 - a
            for dj in range(2):
                wy = b if dj else 1.0 - b
                low, high = field[i + di, j + dj, k], field[i + di, j + dj, top]
                between = (1.0 - c) * low + c * high
                total += wx * wy * between
                gradient[n, 0] += (wy if di else -wy) * between / cell
                gradient[n, 1] += (wx if dj else -wx) * between / cell
                gradient[n, 2] += 0.0 if flat else wx * wy * (high - low) / cell
        distance[n] = total
