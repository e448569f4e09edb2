"""A forest as long as one likes, and a Mid-360-like LiDAR that flies through it: scans for the memory figures.

forest = make_long_forest(1000.0, seed=1)
for scan in fly_along(forest, step_m=0.5): ...

No mesh: trees are trunks and crowns of small leaves, on rolling ground with plants. Leaves are
cells of 12 cm, of which a hash of the position chooses some, so that all scans see the same ones.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numba import njit

from companion.core.messages import Array, Array32
from companion.runtime.bench.mapping_forest import beams_of, rotation

_CELL_M = 4.0  # one tree per cell of the plan: as dense as the forest of the insertion figures
_HALF_WIDTH_M = 60.0
_MARGIN_M = 60.0  # of forest before and behind the way
_HEIGHT_M = 2.0  # of flight above ground
_FARTHEST_M = 70.0  # of a return; longer beams have none
_NEAREST_M = 0.3
_NOISE_M = 0.02
_LEAF_M = 0.12
_LEAVES, _HERBS = 12, 6  # of 256 cells
_HERBS_M = 0.5  # height above ground
u64 = np.uint64


@dataclass(frozen=True, slots=True, eq=False)
class LongForest:
    """Trees by cell of the plan: x, y, radius of the trunk (0: no tree), radius and height of the crown, m."""

    trees: Array  # (X, Y, 5)
    corner: Array  # (2,) of the plan
    length_m: float


@dataclass(frozen=True, slots=True, eq=False)
class LongScan:
    """What `VoxelMap.insert` takes; the sensor is the body's origin."""

    points_body: Array32  # (N, 3), m
    miss_dirs_body: Array32  # (M, 3)
    R_odom_body: Array
    p_odom: Array


def make_long_forest(length_m: float, *, seed: int) -> LongForest:
    """A forest along x from 0 to `length_m`."""
    rng = np.random.default_rng(seed)
    corner = np.array([-_MARGIN_M, -_HALF_WIDTH_M])
    shape = np.ceil((np.array([length_m + _MARGIN_M, _HALF_WIDTH_M]) - corner) / _CELL_M).astype(int)
    middle = corner + (np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), axis=-1) + 0.5) * _CELL_M
    trunk = rng.uniform(0.1, 0.35, shape)
    crown = rng.uniform(0.9, 1.5, shape)
    at = middle + rng.uniform(-0.5, 0.5, middle.shape)  # so that a crown stays inside its cell
    trunk[np.abs(at[..., 1] - _way_y(at[..., 0])) < 1.5] = 0.0
    trees = np.concatenate([at, np.stack([trunk, crown, rng.uniform(9, 15, shape)], axis=-1)], axis=-1)
    return LongForest(trees, corner, length_m)


def fly_along(forest: LongForest, *, step_m: float) -> Iterator[LongScan]:
    """Scans every `step_m` from one end to the other; each depends on its number alone."""
    for number in range(int(forest.length_m / step_m) + 1):
        yield look_from(forest, number * step_m, number)


def look_from(forest: LongForest, x_m: float, number: int) -> LongScan:
    """Scan `number` of the LiDAR's pattern, from the way at `x_m`."""
    y = float(_way_y(np.array(x_m)))
    yaw = math.atan2(float(_way_y(np.array(x_m + 0.05))) - y, 0.05)
    R = rotation(yaw, 0.2 + 0.03 * math.sin(0.21 * number), 0.05 * math.sin(0.17 * number))
    p = np.array([x_m, y, _ground(x_m, y) + _HEIGHT_M])
    beams = beams_of("mid360", number)
    reach = np.empty(len(beams))
    _trace(forest.trees, forest.corner, p, beams @ R.T, reach)
    seen = (reach < _FARTHEST_M) & (reach > _NEAREST_M)
    reach = reach + np.random.default_rng([number, 5]).normal(0.0, _NOISE_M, len(reach))
    points = (beams[seen] * reach[seen, None]).astype(np.float32)
    return LongScan(points, beams[reach >= _FARTHEST_M].astype(np.float32), R, p)


def _way_y(x: Array) -> Array:
    return np.asarray(6.0 * np.sin(x / 30.0))


@njit(cache=True, nogil=True)
def _ground(x, y):  # type: ignore[no-untyped-def]
    return 0.9 * math.sin(x / 17.0) + 0.6 * math.sin(y / 11.0 + 1.0) + 0.2 * math.sin((x + y) / 4.0)


@njit(cache=True, nogil=True)
def _trace(trees, corner, p, directions, reach):  # type: ignore[no-untyped-def]
    """Length (N,) of each beam from p to what it meets first; _FARTHEST_M: nothing."""
    for n in range(directions.shape[0]):
        d = directions[n]
        reach[n] = _to_ground(p, d, _FARTHEST_M)
        flat = max(math.hypot(d[0], d[1]), 1e-6)
        t, last = 0.0, (-1, -1)
        while t < reach[n]:  # cells of the plan along the beam; a step may look twice at one
            i = int((p[0] + t * d[0] - corner[0]) / _CELL_M)
            j = int((p[1] + t * d[1] - corner[1]) / _CELL_M)
            if (i, j) != last and 0 <= i < trees.shape[0] and 0 <= j < trees.shape[1] and trees[i, j, 2] > 0.0:
                reach[n] = _to_tree(trees[i, j], p, d, reach[n])
            last = (i, j)
            t += 0.8 / flat


@njit(cache=True, nogil=True)
def _to_ground(p, d, far):  # type: ignore[no-untyped-def]
    """Steps as long as the height allows; among the plants, leaf by leaf."""
    t = 0.0
    while t < far:
        x, y, z = p[0] + t * d[0], p[1] + t * d[1], p[2] + t * d[2]
        if z > 18.0 and d[2] > 0.0:
            return far
        height = z - _ground(x, y)
        if height < 0.03:
            return t
        if height < _HERBS_M and _leaf(x, y, z, _HERBS):
            return t
        t += max(0.5 * (height - _HERBS_M), 0.03 + 0.3 * min(height, 0.2))
    return far


@njit(cache=True, nogil=True)
def _to_tree(tree, p, d, far):  # type: ignore[no-untyped-def]
    """To the trunk, or to a leaf of the crown."""
    x, y, radius, crown, top = tree
    foot = _ground(x, y)
    ox, oy = p[0] - x, p[1] - y
    a, b, c = d[0] * d[0] + d[1] * d[1], ox * d[0] + oy * d[1], ox * ox + oy * oy - radius * radius
    inside = b * b - a * c
    if inside > 0.0 and a > 1e-9:
        t = (-b - math.sqrt(inside)) / a
        if 0.0 < t < far and p[2] + t * d[2] < foot + top:
            far = t
    tall = 0.3 * top
    s, oz = crown / tall, p[2] - foot - top + 0.8 * tall
    ez, fz = oz * s, d[2] * s
    a, b = d[0] * d[0] + d[1] * d[1] + fz * fz, ox * d[0] + oy * d[1] + ez * fz
    c = ox * ox + oy * oy + ez * ez - crown * crown
    inside = b * b - a * c
    if inside <= 0.0:
        return far
    t, end = max((-b - math.sqrt(inside)) / a, 0.0), min((-b + math.sqrt(inside)) / a, far)
    while t < end:
        if _leaf(p[0] + t * d[0], p[1] + t * d[1], p[2] + t * d[2], _LEAVES):
            return t
        t += 0.5 * _LEAF_M
    return far


@njit(cache=True, nogil=True)
def _leaf(x, y, z, of_256):  # type: ignore[no-untyped-def]
    """Whether the cell that holds the point is a leaf."""
    i, j, k = u64(int(x / _LEAF_M) + 65536), u64(int(y / _LEAF_M) + 65536), u64(int(z / _LEAF_M) + 65536)
    h = i * u64(0x9E3779B97F4A7C15) ^ j * u64(0xC2B2AE3D27D4EB4F) ^ k * u64(0x165667B19E3779F9)
    h ^= h >> u64(31)
    h *= u64(0xBF58476D1CE4E5B9)
    return (h >> u64(56)) < u64(of_256)
