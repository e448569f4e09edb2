"""A hall of racks: aisles that look alike, told apart only by what lies on the shelves."""

from __future__ import annotations

import numpy as np

from companion.core.messages import Array
from sim.world.solids import box_triangles, cut_small
from sim.world.spec import WarehouseSpec

_POST_M, _BEAM_M, _BEAM_HEIGHT_M = 0.1, 0.05, 0.12
_LONGEST_M = 4.0  # of a triangle
_WALL_M = 0.2


def hall_size(spec: WarehouseSpec) -> Array:
    """Length and breadth of the hall inside, m, (2,)."""
    length = spec.bays * spec.bay_m + 2 * spec.cross_aisle_m
    return np.array([length, spec.rack_rows * spec.rack_depth_m + (spec.rack_rows + 1) * spec.aisle_m])


def hall_start(spec: WarehouseSpec) -> Array:
    """The middle of the cross aisle at the low end of x, (2,)."""
    return np.array([spec.cross_aisle_m / 2, hall_size(spec)[1] / 2])


def warehouse_triangles(spec: WarehouseSpec, rng: np.random.Generator) -> Array:
    """Racks, loads, outer walls and roof (T, 3, 3), m; x along the aisles, floor at z 0, hall in [0, size]."""
    boxes = [_hall(spec), _posts(spec), _beams(spec), _loads(spec, rng)]
    middles, halves = (np.concatenate([box[k] for box in boxes]) for k in range(2))
    return cut_small(box_triangles(middles, halves), _LONGEST_M)


def _hall(spec: WarehouseSpec) -> tuple[Array, Array]:
    """Four walls and a roof."""
    (x, y), z, t = hall_size(spec), spec.height_m, _WALL_M
    low_high = [
        ((-t, -t, -t), (0, y + t, z)), ((x, -t, -t), (x + t, y + t, z)),
        ((-t, -t, -t), (x + t, 0, z)), ((-t, y, -t), (x + t, y + t, z)), ((-t, -t, z), (x + t, y + t, z + t)),
    ]  # fmt: skip
    return _between(np.array(low_high, np.float64))


def _rows(spec: WarehouseSpec) -> Array:
    """Low y of each rack, (rack_rows,)."""
    return np.asarray(spec.aisle_m + np.arange(spec.rack_rows) * (spec.aisle_m + spec.rack_depth_m), np.float64)


def _posts(spec: WarehouseSpec) -> tuple[Array, Array]:
    x = spec.cross_aisle_m + spec.bay_m * np.arange(spec.bays + 1)
    y = np.concatenate([_rows(spec), _rows(spec) + spec.rack_depth_m - _POST_M])
    corner = np.stack(np.meshgrid(x, y, [0.0], indexing="ij"), axis=-1).reshape(-1, 3)
    return _between(np.stack([corner, corner + np.array([_POST_M, _POST_M, spec.levels * spec.level_m])], axis=1))


def _beams(spec: WarehouseSpec) -> tuple[Array, Array]:
    """Two along each rack at each level above the floor."""
    y = np.concatenate([_rows(spec), _rows(spec) + spec.rack_depth_m - _BEAM_M])
    z = spec.level_m * np.arange(1, spec.levels) - _BEAM_HEIGHT_M
    corner = np.stack(np.meshgrid([spec.cross_aisle_m], y, z, indexing="ij"), axis=-1).reshape(-1, 3)
    return _between(np.stack([corner, corner + np.array([spec.bays * spec.bay_m, _BEAM_M, _BEAM_HEIGHT_M])], axis=1))


def _loads(spec: WarehouseSpec, rng: np.random.Generator) -> tuple[Array, Array]:
    """Two places per bay and level, each taken with `load_share`, each load with a size of its own."""
    x = spec.cross_aisle_m + _POST_M + spec.bay_m / 2 * np.arange(2 * spec.bays)
    z = spec.level_m * np.arange(spec.levels)
    corner = np.stack(np.meshgrid(x, _rows(spec), z, indexing="ij"), axis=-1).reshape(-1, 3)
    corner = corner[rng.random(len(corner)) < spec.load_share]
    room = np.array([spec.bay_m / 2 - _POST_M, spec.rack_depth_m, spec.level_m - _BEAM_HEIGHT_M - 0.1])
    size = room * rng.uniform([0.55, 0.75, 0.35], [0.98, 1.0, 0.98], (len(corner), 3))
    corner = corner + (room - size) * rng.random((len(corner), 3)) * [1.0, 1.0, 0.0]
    return _between(np.stack([corner, corner + size], axis=1))


def _between(low_high: Array) -> tuple[Array, Array]:
    """Middles and half sides of boxes from two corners (K, 2, 3)."""
    return low_high.mean(axis=1), (low_high[:, 1] - low_high[:, 0]) / 2
