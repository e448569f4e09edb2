"""A space from an array of blocked cells: whole maps, plane worlds, textbook grids.

>>> space = GridSpace(blocked, resolution_m=0.2)
>>> space.segment_free(np.array([0.1, 0.1, 0.1]), np.array([9.0, 3.0, 0.1]))
"""

from __future__ import annotations

from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from companion.core.messages import Array
from companion.planning.grid import path_free, segment_free


class GridSpace:
    """Blocked and free cells, (X, Y, Z), or (X, Y) for a plane world whose places all have z = half a cell.

    What is outside is blocked. `distance_m` (X, Y, Z) to the nearest obstacle answers `distance`; without it that is
    0 in a blocked cell and infinite elsewhere.
    """

    def __init__(
        self,
        blocked: NDArray[Any],
        *,
        resolution_m: float,
        origin: Array | None = None,
        distance_m: NDArray[Any] | None = None,
    ) -> None:
        self._flat = blocked.ndim == 2
        cells = blocked[:, :, None] if self._flat else blocked
        self.resolution_m = resolution_m
        self.origin = np.zeros(3) if origin is None else np.asarray(origin, np.float64)
        self.steps = np.ascontiguousarray(cells == 0).astype(np.uint8)
        self._distance_m = np.where(cells, 0.0, np.inf) if distance_m is None else distance_m.reshape(cells.shape)

    @property
    def bounds(self) -> tuple[Array, Array]:
        """Lower and upper corner, m."""
        return self.origin, self.origin + np.array(self.steps.shape) * self.resolution_m

    @cached_property
    def sample_box(self) -> Array:
        """Corners (2, 3) in cells; of no height in a plane world."""
        low, high = np.zeros(3), np.array(self.steps.shape, np.float64)
        if self._flat:
            low[2] = high[2] = 0.5
        return np.stack([low, high])

    def to_cells(self, points: Array) -> Array:
        """odom m -> cells from the corner (not rounded)."""
        cells: Array = (np.asarray(points, np.float64) - self.origin) / self.resolution_m
        return cells

    def to_odom(self, cells: Array) -> Array:
        """Cells from the corner -> odom m."""
        points: Array = cells * self.resolution_m + self.origin
        return points

    def free(self, points: Array) -> NDArray[np.bool_]:
        """Points (N, 3) -> (N,)."""
        return self._at(self.steps, points, outside=0) > 0

    def segment_free(self, a: Array, b: Array) -> bool:
        """Exact."""
        return bool(segment_free(self.steps, self.to_cells(a), self.to_cells(b)))

    def path_free(self, path: Array) -> bool:
        """All segments of a polyline (N, 3)."""
        return bool(path_free(self.steps, np.ascontiguousarray(self.to_cells(path))))

    def distance(self, points: Array) -> Array:
        """Of the cells that hold the points (N, 3); 0 outside."""
        return self._at(self._distance_m, points, outside=0)

    def contains(self, point: Array, *, margin_m: float = 0.0) -> bool:
        """Is the point inside, `margin_m` from the border?"""
        low, high = self.bounds
        return bool(np.all(point >= low + margin_m) and np.all(point < high - margin_m))

    def _at(self, grid: NDArray[Any], points: Array, *, outside: float) -> NDArray[Any]:
        cells = np.floor(self.to_cells(points)).astype(np.int64)
        inside = np.all((cells >= 0) & (cells < self.steps.shape), axis=1)
        answer = np.full(len(cells), outside, grid.dtype)
        answer[inside] = grid[tuple(cells[inside].T)]
        return answer
