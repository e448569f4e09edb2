"""A height band of the map as a 2D occupancy grid: per column the highest P(occupied) in the band.

Source of the grid: S. Thrun, W. Burgard, D. Fox, "Probabilistic Robotics", 2005, chapter 9.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from companion.core.errors import InputError
from companion.core.messages import Array, Array32
from companion.mapping.formats.stored_map import StoredMap
from companion.mapping.rays import BLOCK
from companion.mapping.sensor_model import UNKNOWN

MOST_CELLS = 400_000_000
_FARTHEST_M = 1e7  # NaN and infinity are not within it
GROUND_SLOPE, GROUND_STEP_M = 1.0, 0.4  # as in FieldConfig
_CHUNK = 1 << 15  # blocks whose temporaries are in memory at once
_EXACT = 1e-9  # cells: a border within it of a cell's face is that face


@dataclass(frozen=True, slots=True, eq=False)
class Grid2D:
    """`probability` (X, Y) of being occupied, NaN: unknown. Cell (0, 0) begins at `origin_xy` (2,), m."""

    resolution_m: float
    origin_xy: Array
    probability: Array32


def occupancy_grid(
    stored: StoredMap, low_m: float, high_m: float, *, ground_z: Array32 | None = None, crop: bool = True
) -> Grid2D:
    """The band of cells that reach into low_m .. high_m; one layer of cells if these are equal.

    Heights are z of the frame, or, with `ground_z` (X, Y) of `ground_height`, above the ground.
    A column is unknown where nothing in the band is known. `crop` drops rims that are unknown.
    Takes a canonical map. Raises InputError for a band upside down or in which nothing is known, and
    for an area that is too large.
    """
    if not -_FARTHEST_M <= low_m <= high_m <= _FARTHEST_M:
        raise InputError(f"{low_m:g} to {high_m:g} m is no band", field="band", valid="low <= high")
    cell_m = stored.resolution_m
    base = np.zeros((1, 1)) if ground_z is None else np.asarray(ground_z, np.float64) / cell_m
    low = np.floor(base + low_m / cell_m + _EXACT)
    high = np.maximum(np.ceil(base + high_m / cell_m - _EXACT) - 1, low)
    corner, blocks = _footprint(stored)
    size = BLOCK * blocks
    low, high = (_tiled(np.broadcast_to(a, size)) for a in (low, high))
    best = np.full((*blocks, BLOCK, BLOCK), UNKNOWN, np.int8)
    for rows, column in _columns(stored, corner):
        cells = stored.log_odds[rows].reshape(-1, BLOCK, BLOCK, BLOCK)
        z = (BLOCK * stored.block_xyz[rows, 2])[:, None, None, None] + np.arange(BLOCK)
        inside = (z >= low[column][..., None]) & (z <= high[column][..., None])
        np.maximum.at(best, column, np.where(inside, cells, np.int8(UNKNOWN)).max(axis=3))
    plane = best.transpose(0, 2, 1, 3).reshape(size)
    if not np.any(plane != UNKNOWN):
        raise InputError(f"nothing is known at {low_m:g} to {high_m:g} m", field="band", valid=_heights(stored))
    first = np.zeros(2, np.int64)
    if crop:
        spans = [np.flatnonzero(np.any(plane != UNKNOWN, axis=1 - axis)) for axis in (0, 1)]
        first = np.array([span[0] for span in spans])
        plane = plane[spans[0][0] : spans[0][-1] + 1, spans[1][0] : spans[1][-1] + 1]
    origin_xy = np.asarray((BLOCK * corner + first) * cell_m)
    return Grid2D(cell_m, origin_xy, stored.probability()[plane.view(np.uint8)])


def ground_height(stored: StoredMap) -> Array32:
    """Height (X, Y) of the centre of each column's ground cell, m, over all columns of all blocks.

    Ground is the lowest occupied cell with a free one right above, unless it stands above ground
    seen nearby by more than a step and a slope; where none is seen, that of the nearest column
    with ground holds. Takes a canonical map. Raises InputError if no ground is seen at all.
    """
    corner, blocks = _footprint(stored)
    lowest = np.full((*blocks, BLOCK, BLOCK), np.inf, np.float32)
    above = _bottoms_above(stored)
    for rows, column in _columns(stored, corner):
        cells = stored.log_odds[rows].reshape(-1, BLOCK, BLOCK, BLOCK)
        over = np.concatenate([cells[..., 1:], above[rows][..., None]], axis=3)
        top = (cells >= 0) & (over < 0) & (over != UNKNOWN)
        z = BLOCK * stored.block_xyz[rows, 2][:, None, None] + np.argmax(top, axis=3)
        np.minimum.at(lowest, column, np.where(np.any(top, axis=3), z, np.inf).astype(np.float32))
    cells_z = lowest.transpose(0, 2, 1, 3).reshape(BLOCK * blocks)
    envelope = _cones(cells_z, GROUND_SLOPE)
    seen = np.isfinite(cells_z) & (cells_z <= envelope + GROUND_STEP_M / stored.resolution_m)
    if not np.any(seen):
        raise InputError("no ground is seen in this map", field="ground", valid="heights of the frame")
    nearest = distance_transform_edt(~seen, return_distances=False, return_indices=True)
    return np.asarray((cells_z[tuple(nearest)] + 0.5) * stored.resolution_m, np.float32)


def _footprint(stored: StoredMap) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """First block (2,) and number of blocks (2,) of the map from above."""
    if len(stored.block_xyz) == 0:
        raise InputError("the map is empty", field="blocks", valid="one or more")
    xy = stored.block_xyz[:, :2].astype(np.int64)
    corner = xy.min(axis=0)
    blocks = xy.max(axis=0) - corner + 1
    if int(blocks.prod()) * BLOCK * BLOCK > MOST_CELLS:
        sides = " x ".join(f"{BLOCK * n:,}" for n in blocks)
        raise InputError(f"{sides} cells are too many", field="extent", valid=f"up to {MOST_CELLS:,}")
    return corner, blocks


def _heights(stored: StoredMap) -> str:
    edge_m = BLOCK * stored.resolution_m
    z = stored.block_xyz[:, 2].astype(np.float64)
    return f"heights of the map, within z of {z.min() * edge_m:g} to {(z.max() + 1) * edge_m:g} m"


def _columns(
    stored: StoredMap, corner: NDArray[np.int64]
) -> Iterator[tuple[slice, tuple[NDArray[np.int64], NDArray[np.int64]]]]:
    """Chunks of blocks, and where they stand in arrays over the footprint."""
    for begin in range(0, len(stored.block_xyz), _CHUNK):
        rows = slice(begin, begin + _CHUNK)
        place = stored.block_xyz[rows, :2].astype(np.int64) - corner
        yield rows, (place[:, 0], place[:, 1])


def _tiled(plane: Array) -> Array:
    """(X, Y) as (X / 8, Y / 8, 8, 8)."""
    nx, ny = plane.shape
    return np.asarray(plane.reshape(nx // BLOCK, BLOCK, ny // BLOCK, BLOCK).transpose(0, 2, 1, 3))


def _bottoms_above(stored: StoredMap) -> NDArray[np.int8]:
    """Lowest layer (N, 8, 8) of the block above each; in canonical order that is the next, if any."""
    bottoms = np.full((len(stored.block_xyz), BLOCK, BLOCK), UNKNOWN, np.int8)
    step = np.diff(stored.block_xyz, axis=0)
    stacked = np.flatnonzero(np.all(step == (0, 0, 1), axis=1))
    layers = stored.log_odds.reshape(-1, BLOCK, BLOCK, BLOCK)[..., 0]
    bottoms[stacked] = layers[stacked + 1]
    return bottoms


def _cones(height: Array32, slope: float) -> Array32:
    """Lower envelope of cones of that slope on each column, with |dx| + |dy| as distance: four running minima."""
    for axis in (0, 1):
        ramp = slope * np.arange(height.shape[axis], dtype=np.float32)
        ramp = ramp[:, None] if axis == 0 else ramp
        ahead = np.minimum.accumulate(height - ramp, axis=axis) + ramp
        back = np.flip(np.minimum.accumulate(np.flip(height + ramp, axis), axis=axis), axis) - ramp
        height = np.minimum(ahead, back)
    return height
