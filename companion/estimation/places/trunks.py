"""Trunks in a levelled cloud: columns that are occupied all the way from knee to above the head.

A cell counts when points lie in most of the height bands in it or beside it; cells that touch are
one trunk; a circle through its points gives centre and radius (I. Kasa, "A circle fitting
procedure and its error analysis", 1976), also if only one side was seen.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Annotated

import msgspec
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from companion.core.errors import InputError
from companion.core.messages import Array

Metres = Annotated[float, msgspec.Meta(gt=0)]
Count = Annotated[int, msgspec.Meta(ge=1)]


class TrunkConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """What a trunk looks like in points."""

    lowest_m: Metres = 0.6  # above ground: lower stand ferns
    highest_m: Metres = 3.0
    bands: Annotated[int, msgspec.Meta(ge=2, le=30)] = 8  # of height between them
    least_bands: Count = 5  # of these with a point
    cell_m: Metres = 0.1
    ground_cell_m: Metres = 2.0  # the lowest point of a cell of this size is its ground
    least_points: Count = 12
    thinnest_m: Metres = 0.03  # radius
    thickest_m: Metres = 0.6
    roundness_m: Metres = 0.05  # median distance of the points to the circle, at most
    widest_m: Metres = 1.2  # extent of what may be a trunk without being round

    def __post_init__(self) -> None:
        if self.least_bands > self.bands:
            raise InputError(f"{self.least_bands} of {self.bands} bands", field="least_bands", valid=f"<= {self.bands}")
        if self.lowest_m >= self.highest_m:
            raise InputError(f"{self.lowest_m} to {self.highest_m} m", field="highest_m", valid=f"> {self.lowest_m}")


@dataclass(frozen=True, slots=True, eq=False)
class Trunks:
    """In the frame of the cloud."""

    centers: Array  # (K, 2), m
    radii: Array  # (K,), m
    points: NDArray[np.int64]  # (K,), that each was found in


def detect_trunks(points: Array, config: TrunkConfig) -> Trunks:
    """Trunks in `points` (N, 3), m, of a frame whose z is up; what is not finite is left out."""
    cloud = np.asarray(points, np.float64)
    cloud = cloud[np.isfinite(cloud @ np.ones(3))]
    if not len(cloud):
        return _trunks([])
    height = cloud[:, 2] - _ground_below(cloud, config.ground_cell_m)
    inside = (height > config.lowest_m) & (height < config.highest_m)
    cloud, height = cloud[inside], height[inside]
    if not len(cloud):
        return _trunks([])
    label = _columns(cloud, height, config)
    order = np.argsort(label, kind="stable")
    firsts = np.searchsorted(label[order], np.arange(1, label.max() + 2))
    found = (_trunk(cloud[order[a:b], :2], config) for a, b in pairwise(firsts.tolist()))
    return _trunks([trunk for trunk in found if trunk is not None])


def _trunks(rows: list[tuple[float, float, float, int]]) -> Trunks:
    table = np.array(rows, np.float64).reshape(-1, 4)
    return Trunks(table[:, :2], table[:, 2], table[:, 3].astype(np.int64))


def _cells(cloud: Array, cell_m: float) -> tuple[NDArray[np.int64], NDArray[np.int64], tuple[int, int]]:
    """Column and row of each point, and how many there are; a rim of one cell is left free."""
    cell = np.floor(cloud[:, :2] / cell_m).astype(np.int64)
    cell -= cell.min(axis=0) - 1
    return cell[:, 0], cell[:, 1], (int(cell[:, 0].max()) + 2, int(cell[:, 1].max()) + 2)


def _ground_below(cloud: Array, cell_m: float) -> Array:
    """Height of the lowest point of the cell of each point, (N,)."""
    i, j, shape = _cells(cloud, cell_m)
    lowest = np.full(shape, np.inf)
    np.minimum.at(lowest, (i, j), cloud[:, 2])
    ground: Array = lowest[i, j]
    return ground


def _columns(cloud: Array, height: Array, config: TrunkConfig) -> NDArray[np.int64]:
    """Number (N,) of the column that each point belongs to; 0: none."""
    i, j, shape = _cells(cloud, config.cell_m)
    share = (height - config.lowest_m) / (config.highest_m - config.lowest_m)
    band = np.clip((share * config.bands).astype(np.int64), 0, config.bands - 1)
    seen = np.zeros(shape, np.int64)
    np.bitwise_or.at(seen, (i, j), 1 << band)
    around = seen.copy()  # a trunk that leans crosses from cell to cell
    for axis in (0, 1):
        one = around.copy()
        for shift in (-1, 1):
            around |= np.roll(one, shift, axis)
    count = np.bitwise_count(around.astype(np.uint64))
    tall = (count >= config.least_bands) & (seen > 0)
    label, _ = ndimage.label(tall, structure=np.ones((3, 3)))
    numbers: NDArray[np.int64] = np.asarray(label, np.int64)[i, j]
    return numbers


def _trunk(points: Array, config: TrunkConfig) -> tuple[float, float, float, int] | None:
    """Centre x, y, radius and points of one column; None: no trunk."""
    if len(points) < config.least_points:
        return None
    x, y, radius = _circle(points)
    off = np.abs(np.hypot(points[:, 0] - x, points[:, 1] - y) - radius)
    if config.thinnest_m < radius < config.thickest_m and float(np.median(off)) < config.roundness_m:
        return x, y, radius, len(points)
    extent = np.ptp(points, axis=0)
    if extent.max() >= config.widest_m:
        return None
    middle = np.median(points, axis=0)
    return float(middle[0]), float(middle[1]), min(float(extent.max()) / 2.0, config.thickest_m), len(points)


def _circle(points: Array) -> tuple[float, float, float]:
    """The circle of least algebraic error."""
    middle = points.mean(axis=0)
    near = points - middle
    system = np.hstack([2.0 * near, np.ones((len(near), 1))])
    solution = np.linalg.lstsq(system, np.sum(near * near, axis=1), rcond=None)[0]
    radius = float(np.sqrt(max(solution[2] + solution[:2] @ solution[:2], 0.0)))
    return float(middle[0] + solution[0]), float(middle[1] + solution[1]), radius
