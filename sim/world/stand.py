"""Trees: where they stand, how high they are, and their trunks, branches and leaves."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from companion.core.errors import InputError
from companion.core.messages import Array
from sim.world.model import Stems
from sim.world.spec import PoissonSpec, TreesSpec

ROOT_M = 0.3  # a trunk starts this far below the ground
_BREAST_M = 1.3  # where the diameter is measured
_TIP = 0.15  # radius at the top over radius at breast height
_DENSEST = 0.5  # share of the area that random sequential discs fill in reasonable time (jamming: 0.547)


def scatter(spec: PoissonSpec, rng: np.random.Generator) -> Array:
    """Stem centres (N, 2) in [0, size]^2: N is Poisson, each placed at random where it is allowed.

    Simple sequential inhibition with `min_spacing_m` (Diggle 2003); raises InputError if
    the stand would be too dense for it.
    """
    count = int(rng.poisson(spec.stems_per_ha * spec.size_m**2 / 1e4))
    disc_area = math.pi * (spec.min_spacing_m / 2) ** 2
    if spec.stems_per_ha * disc_area > _DENSEST * 1e4:
        most = _DENSEST * 1e4 / disc_area
        raise InputError(
            f"{spec.stems_per_ha:g} stems do not fit at a spacing of {spec.min_spacing_m:g} m",
            field="stems_per_ha",
            valid=f"at most {most:.0f}",
        )
    if spec.min_spacing_m == 0:
        return rng.uniform(0.0, spec.size_m, (count, 2))
    return _inhibited(count, spec, rng)


def _inhibited(count: int, spec: PoissonSpec, rng: np.random.Generator) -> Array:
    cell, near = spec.min_spacing_m, (-1, 0, 1)
    grid: dict[tuple[int, int], list[tuple[float, float]]] = {}
    kept: list[tuple[float, float]] = []
    while len(kept) < count:
        for x, y in rng.uniform(0.0, spec.size_m, (count, 2)).tolist():
            i, j = int(x / cell), int(y / cell)
            others = (o for a in near for b in near for o in grid.get((i + a, j + b), ()))
            if any((ox - x) ** 2 + (oy - y) ** 2 < cell**2 for ox, oy in others):
                continue
            grid.setdefault((i, j), []).append((x, y))
            kept.append((x, y))
            if len(kept) == count:
                break
    return np.array(kept).reshape(-1, 2)


def draw_diameters(spec: PoissonSpec, count: int, rng: np.random.Generator) -> Array:
    """Log-normal with the given mean and deviation, between 2 cm and 2 m."""
    variance = math.log1p((spec.dbh_sd_m / spec.dbh_mean_m) ** 2)
    drawn = rng.lognormal(math.log(spec.dbh_mean_m) - variance / 2, math.sqrt(variance), count)
    return np.clip(drawn, 0.02, 2.0)


def heights_of(spec: TreesSpec, dbh_m: Array, rng: np.random.Generator) -> Array:
    """Tree heights by the dbh-height curve of Meyer (1940) with a relative spread; 2 m at least."""
    curve = _BREAST_M + (spec.height_max_m - _BREAST_M) * -np.expm1(-spec.height_rate_per_m * dbh_m)
    return np.asarray(np.maximum(2.0, curve * (1 + spec.height_sd * rng.standard_normal(len(dbh_m)))))


def open_place(xy: Array, dbh_m: Array, low: Array, high: Array) -> Array:
    """The most open place (2,) near the middle of [low, high]: half a metre of space outweighs 5 m of way.

    Openness counts up to 6 m; candidates lie on a 0.5 m grid over the middle half.
    """
    middle, half = (low + high) / 2, (high - low) / 4
    steps = [np.arange(-math.floor(h / 0.5), math.floor(h / 0.5) + 1) * 0.5 for h in half]
    offset = np.stack(np.meshgrid(*steps, indexing="ij"), axis=-1).reshape(-1, 2)
    room = np.array([free_radius(xy, dbh_m, middle + o) for o in offset])
    score = np.minimum(room, 6.0) - 0.1 * np.linalg.norm(offset, axis=1)
    return np.asarray(middle + offset[int(np.argmax(score))])


def free_radius(xy: Array, dbh_m: Array, point: Array) -> float:
    """Distance from a point to the nearest trunk's surface at breast height; inf without stems."""
    gaps = np.hypot(xy[:, 0] - point[0], xy[:, 1] - point[1]) - dbh_m / 2
    return float(gaps.min(initial=math.inf))


def trunk_cones(stems: Stems, lean_deg: float, rng: np.random.Generator) -> Array:
    """Cones (N, 9) of stems; radius is linear in height."""
    count = len(stems)
    axis = np.ones((count, 3))
    axis[:, :2] = np.tan(np.radians(lean_deg) * np.clip(rng.standard_normal((count, 2)), -3, 3))
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    radius, height = stems.dbh_m / 2, stems.height_m
    taper = radius * (1 - _TIP) / (height - _BREAST_M)
    cones = np.empty((count, 9))
    cones[:, :3] = np.column_stack([stems.x, stems.y, stems.z_ground]) - ROOT_M * axis
    cones[:, 3:6] = axis
    cones[:, 6] = height + ROOT_M
    cones[:, 7] = radius + taper * (_BREAST_M + ROOT_M)
    cones[:, 8] = radius * _TIP
    return cones


def branch_cones(spec: TreesSpec, trunks: Array, rng: np.random.Generator) -> Array:
    """Thin straight cones (K, 9) from the trunks' axes; trees that end below their heights get none."""
    low, high = spec.branch_height_m
    top = np.minimum(high, 0.85 * (trunks[:, 6] - ROOT_M))
    bearing = tree_of_branch(spec, trunks)
    count = len(bearing)
    draw = rng.random((count, 5))
    trunk = trunks[bearing]
    along = low + draw[:, 0] * (top[bearing] - low)
    azimuth, elevation = 2 * math.pi * draw[:, 1], np.radians(-15 + 45 * draw[:, 2])
    cones = np.empty((count, 9))
    cones[:, :3] = trunk[:, :3] + (along + ROOT_M)[:, None] * trunk[:, 3:6]
    cones[:, 3] = np.cos(elevation) * np.cos(azimuth)
    cones[:, 4] = np.cos(elevation) * np.sin(azimuth)
    cones[:, 5] = np.sin(elevation)
    cones[:, 6] = np.interp(draw[:, 3], (0, 1), spec.branch_length_m)
    cones[:, 7] = np.interp(draw[:, 4], (0, 1), spec.branch_diameter_m) / 2
    cones[:, 8] = 0.5 * cones[:, 7]
    return cones


def tree_of_branch(spec: TreesSpec, trunks: Array) -> NDArray[np.int64]:
    """Rows (K,) of the trunks that the branches grow from, in their order."""
    low, high = spec.branch_height_m
    return np.repeat(np.flatnonzero(np.minimum(high, 0.85 * (trunks[:, 6] - ROOT_M)) > low), spec.branches)


def tree_of_leaf(spec: TreesSpec, trunks: Array) -> NDArray[np.int64]:
    """Rows (L,) of the trunks that the leaves grow on, in their order."""
    return np.repeat(np.flatnonzero(trunks[:, 6] - ROOT_M > spec.crown_base_m + 1.0), spec.leaves)


def standing(spec: TreesSpec, count: int, rng: np.random.Generator) -> NDArray[np.bool_]:
    """Which trees (count,) are not felled."""
    return np.asarray(rng.random(count) >= spec.felled)


def leaf_centers(spec: TreesSpec, trunks: Array, rng: np.random.Generator) -> Array:
    """Centres (L, 3) in ellipsoids between the crown's base and the top."""
    height = trunks[:, 6] - ROOT_M
    tree = tree_of_leaf(spec, trunks)
    ball = rng.standard_normal((len(tree), 3))
    ball *= (rng.random(len(tree)) ** (1 / 3) / np.linalg.norm(ball, axis=1))[:, None]
    depth = (height - spec.crown_base_m)[tree] - 2 * spec.leaf_m
    along = ROOT_M + spec.crown_base_m + 2 * spec.leaf_m + depth * (0.5 + 0.5 * ball[:, 2])
    centers = trunks[tree, :3] + along[:, None] * trunks[tree, 3:6]
    centers[:, :2] += spec.crown_radius_m * ball[:, :2]
    return np.asarray(centers)
