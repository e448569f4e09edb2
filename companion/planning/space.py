"""What the planners know about the world: which points and segments are free, how far obstacles are.

`FieldSpace` answers from a `LocalMap`. A cell is blocked when the distance at its centre is
below the vehicle's radius or when it lies outside the band above ground. Segments are checked
by exact voxel traversal (Amanatides and Woo 1987) that jumps where the distance field
proves that nothing blocked can be met (sphere tracing, Hart 1996): same answer, fewer steps.
"""

from __future__ import annotations

import copy
import math
from functools import cached_property
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from companion.core.errors import InputError
from companion.core.messages import Array, Array32, LocalMap
from companion.planning.grid import WINDOW, build_steps, fill_nearest, path_free, sample_field, segment_free

Cells = NDArray[np.int32]
_ROUNDING = 1e-9  # cells: so far inside the border, no rounding leads out of the map
Unknown = Literal["blocked", "stop_before", "optimistic"]


class Space(Protocol):
    """A bounded part of the world, in odom, m."""

    @property
    def bounds(self) -> tuple[Array, Array]:
        """Lower and upper corner, (3,) each."""
        ...

    def free(self, points: Array) -> NDArray[np.bool_]:
        """Which of the points (N, 3) the vehicle's centre may be at, (N,)."""
        ...

    def segment_free(self, a: Array, b: Array) -> bool:
        """May the vehicle's centre go straight from a to b?"""
        ...

    def distance(self, points: Array) -> Array:
        """Distance of the points (N, 3) to the nearest obstacle, m, (N,)."""
        ...


class FieldSpace:
    """Space of one local map for a sphere of `radius_m`.

    With `unknown="blocked"` a cell that is not known free is an obstacle; otherwise the
    geometry takes it as free (the speed profile stops before it, unless `optimistic`).
    Points outside the map are unknown. `agl_m` bounds the height above `ground_z` (X, Y).

    >>> space = FieldSpace(local_map, radius_m=0.85, ground_z=fill_ground(local_map), agl_m=(1.0, 6.0))
    >>> space.segment_free(np.array([0.0, 0.0, 2.0]), np.array([9.0, 0.0, 2.0]))
    """

    def __init__(
        self,
        local_map: LocalMap,
        *,
        radius_m: float,
        ground_z: Array32 | None = None,
        agl_m: tuple[float, float] = (-math.inf, math.inf),
        unknown: Unknown = "stop_before",
    ) -> None:
        self.map, self.radius_m, self.unknown = local_map, radius_m, unknown
        self.origin, self.resolution_m = local_map.origin_odom, local_map.resolution_m
        self._field = local_map.unknown_distance_m if unknown == "blocked" else local_map.distance_m
        if self._field.shape != local_map.state.shape:
            raise InputError(
                f"a field of {self._field.shape} cells", field="local_map", valid=f"{local_map.state.shape}"
            )
        self._bands = self._bands_of(ground_z, agl_m)
        self.steps = self._built()
        """0: blocked; 1 + n: free, and a jump of n / JUMP_UNIT cells meets nothing blocked."""

    def with_radius(self, radius_m: float) -> FieldSpace:
        """The same space for a sphere of another radius."""
        other = copy.copy(self)
        other.radius_m = radius_m
        other.steps = other._built()
        return other

    def _built(self) -> NDArray[np.uint8]:
        steps = np.empty(self.map.state.shape, np.uint8)
        build_steps(self._field, self._bands, self.radius_m, self.resolution_m, steps)
        return steps

    def _bands_of(self, ground_z: Array32 | None, agl_m: tuple[float, float]) -> tuple[Cells, Cells, Cells, Cells]:
        """Lowest and highest allowed cell of each column, and the tightest of the columns near it."""
        nx, ny, nz = self.map.state.shape
        low, high = np.zeros((nx, ny), np.int32), np.full((nx, ny), nz - 1, np.int32)
        if ground_z is not None:
            above = (ground_z.astype(np.float64) - self.origin[2]) / self.resolution_m - 0.5
            low[:] = np.clip(np.ceil(above + agl_m[0] / self.resolution_m - 1e-3), 0, nz)
            high[:] = np.clip(np.floor(above + agl_m[1] / self.resolution_m + 1e-3), -1, nz - 1)
        return low, high, _highest_near(low), -_highest_near(-high)

    @property
    def bounds(self) -> tuple[Array, Array]:
        """Corners of the local map, m."""
        return self.origin, self.origin + np.array(self.map.state.shape) * self.resolution_m

    def to_cells(self, points: Array) -> Array:
        """odom m -> cells from the map's corner (not rounded)."""
        cells: Array = (np.asarray(points, np.float64) - self.origin) / self.resolution_m
        return cells

    def to_odom(self, cells: Array) -> Array:
        """Cells from the map's corner -> odom m."""
        points: Array = cells * self.resolution_m + self.origin
        return points

    def free(self, points: Array) -> NDArray[np.bool_]:
        """Points (N, 3) -> (N,)."""
        cells = np.floor(self.to_cells(points)).astype(np.int64)
        inside = np.all((cells >= 0) & (cells < self.map.state.shape), axis=1)
        answer = np.full(len(cells), self.unknown != "blocked")
        answer[inside] = self.steps[tuple(cells[inside].T)] > 0
        return answer

    def segment_free(self, a: Array, b: Array) -> bool:
        """Exact; the part outside the map counts as unknown."""
        p, q = self.to_cells(a), self.to_cells(b)
        part = _clip(p, q, np.array(self.map.state.shape, np.float64))
        whole_inside = part is not None and part == (0.0, 1.0)
        if not whole_inside and self.unknown == "blocked":
            return False
        if part is None:
            return True
        inner_p, inner_q = p + part[0] * (q - p), p + part[1] * (q - p)
        low, high = _ROUNDING, np.array(self.map.state.shape) - _ROUNDING
        return bool(segment_free(self.steps, np.clip(inner_p, low, high), np.clip(inner_q, low, high)))

    def path_free(self, path: Array) -> bool:
        """All segments of a polyline (N, 3), which must lie in the map."""
        return bool(path_free(self.steps, np.ascontiguousarray(self.to_cells(path))))

    def distance(self, points: Array) -> Array:
        """Trilinear distance to the nearest occupied cell (N,), m; truncated as the map's."""
        return distance_in(self.map, points)

    def nearest_free(self, point: Array, *, within_m: float) -> Array | None:
        """Centre of the nearest free cell, or the point itself if free; None if there is none."""
        if bool(self.free(point[None])[0]) and self.contains(point):
            return point
        candidates = self.free_cells_near(point, within_m=within_m)
        return candidates[0] if len(candidates) else None

    def free_cells_near(self, point: Array, *, within_m: float) -> Array:
        """Centres of free cells (K, 3) within a distance, nearest first."""
        shape = np.array(self.map.state.shape)
        low = np.clip(np.floor(self.to_cells(point - within_m)), 0, shape).astype(int)
        high = np.clip(np.ceil(self.to_cells(point + within_m)), 0, shape).astype(int)
        box = self.steps[low[0] : high[0], low[1] : high[1], low[2] : high[2]]
        centers = self.to_odom(np.argwhere(box > 0) + low + 0.5)
        gap = np.linalg.norm(centers - point, axis=1)
        order = np.argsort(gap, kind="stable")
        near: Array = centers[order[gap[order] <= within_m]]
        return near

    def heights(self, i: int, j: int) -> tuple[float, float]:
        """Lowest and highest allowed z of column (i, j): cell centres, odom, m; low > high: none."""
        low, high = (float(band[i, j] + 0.5) * self.resolution_m for band in self._bands[:2])
        return low + float(self.origin[2]), high + float(self.origin[2])

    @cached_property
    def sample_box(self) -> Array:
        """Corners (2, 3), in cells, of the box that holds all free cells: the band, map-wide."""
        nx, ny, _ = self.map.state.shape
        low, high = int(self._bands[0].min()), int(self._bands[1].max()) + 1
        return np.array([[0.0, 0.0, float(low)], [float(nx), float(ny), float(max(high, low + 1))]])

    def contains(self, point: Array, *, margin_m: float = 0.0) -> bool:
        """Is the point inside the local map, `margin_m` from its border?"""
        low, high = self.bounds
        return bool(np.all(point >= low + margin_m) and np.all(point < high - margin_m))


def distance_in(local_map: LocalMap, points: Array) -> Array:
    """Trilinear distance of points (N, 3) to the nearest occupied cell (N,), m; truncated as the map's."""
    cells = np.ascontiguousarray((np.asarray(points, np.float64) - local_map.origin_odom) / local_map.resolution_m)
    values: Array = sample_field(local_map.distance_m, cells)
    return values


def serves(local_map: LocalMap, unknown: Unknown) -> bool:
    """Can a space with that policy be built on the map? Not every map says how far unknown space is."""
    return unknown != "blocked" or local_map.unknown_distance_m.size > 0


def part_around(local_map: LocalMap, points: Array) -> LocalMap:
    """A copy of the box of the map that holds all cells on straight ways between points (N, 3) of it.

    A space is built cell by cell: for a look at one way, a box costs a hundredth of the map.
    """
    shape, cell_m = np.array(local_map.state.shape), local_map.resolution_m
    cells = (points - local_map.origin_odom) / cell_m
    low = np.clip(np.floor(cells.min(axis=0)).astype(int) - 1, 0, shape - 1)
    high = np.clip(np.floor(cells.max(axis=0)).astype(int) + 2, low + 1, shape)
    box = tuple(slice(a, b) for a, b in zip(low, high, strict=True))
    return LocalMap(
        stamp_ns=local_map.stamp_ns,
        origin_odom=local_map.origin_odom + low * cell_m,
        resolution_m=cell_m,
        state=local_map.state[box].copy(),
        distance_m=local_map.distance_m[box].copy(),
        unknown_distance_m=local_map.unknown_distance_m[box].copy(),
        ground_z_odom=local_map.ground_z_odom[box[:2]].copy(),
    )


def fill_ground(local_map: LocalMap, *, fallback_z: float = math.nan) -> Array32 | None:
    """Ground height (X, Y), odom m: seen, else as the nearest seen; None: never seen at all."""
    ground = local_map.ground_z_odom
    if np.isnan(ground).all():
        return None if math.isnan(fallback_z) else np.full(ground.shape, fallback_z, np.float32)
    filled = ground.copy()
    fill_nearest(filled, np.empty((filled.shape[0] + 2, filled.shape[1] + 2), np.float32))
    return filled


def _highest_near(cells: Cells) -> Cells:
    """Maximum (X, Y) over the square of +- WINDOW columns."""
    for axis in (0, 1):
        along = np.moveaxis(cells, axis, 0)
        near = along.copy()
        for n in range(1, WINDOW + 1):
            np.maximum(near[n:], along[:-n], out=near[n:])
            np.maximum(near[:-n], along[n:], out=near[:-n])
        cells = np.moveaxis(near, 0, axis)
    return np.ascontiguousarray(cells)


def _clip(p: Array, q: Array, shape: Array) -> tuple[float, float] | None:
    """Part [t0, t1] of the segment p..q inside the box 0..shape; None: it misses the box."""
    t0, t1 = 0.0, 1.0
    for k in range(3):
        way = q[k] - p[k]
        if abs(way) < 1e-12:
            if not 0.0 <= p[k] < shape[k]:
                return None
            continue
        enter, leave = sorted(((0.0 - p[k]) / way, (shape[k] - p[k]) / way))
        t0, t1 = max(t0, enter), min(t1, leave)
    return (t0, t1) if t0 <= t1 else None
