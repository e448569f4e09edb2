"""A saved map as a place to be found in: its occupied points, and where a vehicle could be."""

from __future__ import annotations

import math

import numpy as np

from companion.core.messages import Array
from companion.estimation.places.locate import LocateConfig, Locator
from companion.mapping.formats.grid import ground_height
from companion.mapping.formats.stored_map import StoredMap
from companion.mapping.rays import BLOCK
from companion.mapping.sensor_model import UNKNOWN

_STEP_M = 0.6  # between places that are tried, at least
_MOST_EYES = 8000  # in larger maps they lie farther apart


def locator_of(
    stored: StoredMap, *, height_m: float, config: LocateConfig | None = None, noise_m: float = 0.0, seed: int = 0
) -> Locator:
    """Ready to find views taken `height_m` above ground; raises InputError for a map without ground.

    `noise_m` is for studies: the occupied points are moved by so much at random, per axis.
    """
    points, _ = stored.occupied()
    points += np.random.default_rng(seed).normal(0.0, noise_m, points.shape)
    return Locator(points.astype(np.float32), free_eyes(stored, height_m), config or LocateConfig())


def free_eyes(stored: StoredMap, height_m: float) -> Array:
    """Points (M, 3) of a level grid, `height_m` above ground, whose cells are known to be free."""
    ground = ground_height(stored)
    low = stored.block_xyz.min(axis=0).astype(np.int64) * BLOCK
    apart_m = max(_STEP_M, stored.resolution_m * math.sqrt(ground.size / _MOST_EYES))
    step = max(round(apart_m / stored.resolution_m), 1)
    i, j = (v.ravel() for v in np.meshgrid(*(np.arange(0, n, step) for n in ground.shape), indexing="ij"))
    z = ground[i, j] + height_m
    cell = np.stack([low[0] + i, low[1] + j, np.floor(z / stored.resolution_m).astype(np.int64)], axis=1)
    state = _states(stored, cell)
    eyes = np.column_stack([(cell[:, :2] + 0.5) * stored.resolution_m, z])
    return np.asarray(eyes[(state < 0) & (state != UNKNOWN)], np.float64)


def _states(stored: StoredMap, cell: Array) -> Array:
    """Log-odds (M,) of cells (M, 3)."""
    block, inside = np.floor_divide(cell, BLOCK), np.mod(cell, BLOCK)
    rows = {tuple(b): n for n, b in enumerate(stored.block_xyz.tolist())}
    row = np.array([rows.get(tuple(b), -1) for b in block.tolist()])
    number = (inside[:, 0] * BLOCK + inside[:, 1]) * BLOCK + inside[:, 2]
    return np.where(row >= 0, stored.log_odds[row, number], UNKNOWN).astype(np.int64)
