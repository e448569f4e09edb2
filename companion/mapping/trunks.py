"""Tree trunks in a local map: what is occupied at breast height and goes on above and below.

Foresters measure at 1.3 m above ground; so do we, in a slice around it. A column of the map
belongs to a trunk if it is occupied at most heights up to well above; branches cross only a few.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

import msgspec
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from companion.core.messages import Array, LocalMap
from companion.mapping.voxel_map import OCCUPIED_CELL

_Metres = Annotated[float, msgspec.Meta(gt=0.0)]
_Share = Annotated[float, msgspec.Meta(gt=0.0, le=1.0)]
BREAST_HEIGHT_M = 1.3
_AROUND_CELLS, _SEEN_SHARE = 3, 0.5  # ground that must be seen around a trunk


class TrunkConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """What counts as a trunk, and how well it is placed. Heights are above ground."""

    range_m: _Metres = 10.0  # half side of the square around the vehicle that is looked at
    slice_m: tuple[_Metres, _Metres] = (1.0, 1.6)  # a trunk is occupied here
    extent_m: tuple[_Metres, _Metres] = (0.6, 2.6)  # and at most heights from here to there
    column_share: _Share = 0.4  # of those heights, for a column to count
    trunk_share: _Share = 0.7  # of those heights, by all columns of a trunk together
    max_radius_m: _Metres = 0.6
    ground_gap_m: Annotated[float, msgspec.Meta(ge=0.0)] = 1.0  # how far seen ground may be away
    position_sigma_m: _Metres = 0.08  # across; of a middle of cells
    height_sigma_m: _Metres = 0.12  # of the ground under it


@dataclass(frozen=True, slots=True, eq=False)
class Trunks:
    """Trunks seen in one local map."""

    position_odom: Array  # of the axis at breast height, m, (N, 3)
    covariance: Array  # m2, (N, 3, 3)
    radius_m: Array  # (N,)
    residual_m: Array  # (N,), rms distance of its cells from that circle


def trunks(local_map: LocalMap, center_odom: Array, config: TrunkConfig) -> Trunks:
    """Trunks within `range_m` of a point (3,), in the order of their cells."""
    box = _crop(local_map, center_odom, config)
    heights = np.arange(*config.extent_m, local_map.resolution_m)
    occupied = _at_heights(box, heights)
    at_breast = (heights >= config.slice_m[0]) & (heights < config.slice_m[1])
    counts = occupied.sum(axis=2)
    strong = occupied[:, :, at_breast].any(axis=2) & (counts >= config.column_share * len(heights))
    labels, number = ndimage.label(strong, np.ones((3, 3)))
    found = [
        _measure(box, cells, counts)
        for cells in _clusters(labels, number)
        if occupied[tuple(cells.T)].any(axis=0).mean() >= config.trunk_share
    ]
    good = [f for f in found if f[3] <= config.max_radius_m and math.isfinite(f[2])]
    table = np.array(good).reshape(-1, 5)
    sigma = np.array([config.position_sigma_m, config.position_sigma_m, config.height_sigma_m])
    covariance = np.tile(np.diag(sigma**2), (len(table), 1, 1))
    return Trunks(table[:, :3].copy(), covariance, table[:, 3].copy(), table[:, 4].copy())


@dataclass(frozen=True, slots=True, eq=False)
class _Box:
    """A part of a local map."""

    state: NDArray[np.uint8]  # (X, Y, Z)
    seen_z: Array  # height of seen ground, m, NaN: none, (X, Y)
    ground_z: Array  # height of the nearest seen ground, m, NaN: too far, (X, Y)
    corner_odom: Array  # of its first cell, m, (3,)
    cell_m: float


def _crop(local_map: LocalMap, center_odom: Array, config: TrunkConfig) -> _Box:
    cell_m, shape = local_map.resolution_m, local_map.state.shape
    middle = np.floor((center_odom - local_map.origin_odom) / cell_m).astype(int)
    reach = int(config.range_m / cell_m)
    x, y = (slice(max(middle[k] - reach, 0), max(min(middle[k] + reach + 1, shape[k]), 0)) for k in (0, 1))
    ground = local_map.ground_z_odom[x, y].astype(np.float64)
    corner = local_map.origin_odom + np.array([x.start, y.start, 0]) * cell_m
    return _Box(local_map.state[x, y], ground, _filled(ground, config.ground_gap_m / cell_m), corner, cell_m)


def _filled(ground: Array, gap_cells: float) -> Array:
    """NaN replaced by the nearest value within `gap_cells`: a trunk hides the ground that it stands on."""
    unseen = np.isnan(ground)
    if unseen.all():
        return ground
    far, nearest = ndimage.distance_transform_edt(unseen, return_indices=True)
    return np.where(far <= gap_cells, ground[tuple(nearest)], np.nan)


def _at_heights(box: _Box, heights_m: Array) -> NDArray[np.bool_]:
    """Which columns are occupied at heights (S,) above their ground: (X, Y, S)."""
    occupied = np.zeros((*box.ground_z.shape, len(heights_m)), np.bool_)
    x, y = np.nonzero((box.state == OCCUPIED_CELL).any(axis=2) & np.isfinite(box.ground_z))
    levels = (box.ground_z[x, y, None] + heights_m - box.corner_odom[2]) / box.cell_m
    inside = (levels >= 0.0) & (levels < box.state.shape[2])
    index = np.where(inside, levels, 0.0).astype(np.int64)
    occupied[x, y] = inside & (box.state[x[:, None], y[:, None], index] == OCCUPIED_CELL)
    return occupied


def _clusters(labels: NDArray[np.int32], number: int) -> list[NDArray[np.int64]]:
    """Columns (n, 2) of each label from 1 on."""
    cells = np.argwhere(labels > 0)
    of = labels[tuple(cells.T)]
    return [cells[of == n] for n in range(1, number + 1)]


def _measure(
    box: _Box, cells: NDArray[np.int64], counts: NDArray[np.int64]
) -> tuple[float, float, float, float, float]:
    """x, y, z at breast height, radius and residual, m.

    The middle is weighted by how many heights each column fills. A ring of radius r has a mean
    square distance of r^2 from its middle, and a cell of edge c adds c^2 / 6.
    """
    i, j = cells.T
    weight = counts[i, j] / counts[i, j].sum()
    xy = box.corner_odom[:2] + (cells + 0.5) * box.cell_m
    middle = weight @ xy
    away = np.linalg.norm(xy - middle, axis=1)
    smallest = box.cell_m / 4
    radius = float(np.sqrt(max(weight @ away**2 - box.cell_m**2 / 6, smallest**2)))
    residual = float(np.sqrt(weight @ (away - radius) ** 2))
    z = _ground_around(box, cells) + BREAST_HEIGHT_M
    return float(middle[0]), float(middle[1]), z, radius, residual


def _ground_around(box: _Box, cells: NDArray[np.int64]) -> float:
    """Usual height in the neighbourhood, NaN: too little seen.

    In a trunk's own columns, and where only trunks were seen so far, the lowest return is a trunk's.
    """
    low, high = np.maximum(cells.min(axis=0) - _AROUND_CELLS, 0), cells.max(axis=0) + _AROUND_CELLS + 1
    around = box.seen_z[low[0] : high[0], low[1] : high[1]]
    seen = around[np.isfinite(around)]
    return float(np.median(seen)) if len(seen) >= _SEEN_SHARE * around.size else math.nan
