"""A mine: tunnels with rough walls between junctions, some of them in rings."""

from __future__ import annotations

import numpy as np
from scipy import ndimage
from scipy.spatial import cKDTree

from companion.core.messages import Array
from sim.world.solids import skin
from sim.world.spec import MineSpec

_STEP_M = 0.5  # between points of a centre line
_ARCH = 4.0  # exponent of the cross section: between an ellipse and a rectangle
_BELOW_M = 1.2  # walls go on below the floor
_AROUND_M = 3.0  # of rock about the outermost centre lines


def junctions(spec: MineSpec, rng: np.random.Generator) -> Array:
    """Junctions (nx, ny, 2), m: a grid over [0, size]^2, each shifted at random."""
    count = max(round(spec.size_m / spec.spacing_m), 2)
    line = (np.arange(count) + 0.5) * spec.size_m / count
    grid = np.stack(np.meshgrid(line, line, indexing="ij"), axis=-1)
    return np.asarray(grid + rng.uniform(-1.0, 1.0, grid.shape) * spec.jitter_m)


def tunnels(nodes: Array, spec: MineSpec, rng: np.random.Generator) -> list[Array]:
    """Centre lines (K, 2), m: a random spanning tree of the grid (Kruskal 1956), and `loops` of the other edges."""
    nx, ny = nodes.shape[:2]
    number = np.arange(nx * ny).reshape(nx, ny)
    along_x = np.stack([number[:-1], number[1:]], axis=-1).reshape(-1, 2)
    along_y = np.stack([number[:, :-1], number[:, 1:]], axis=-1).reshape(-1, 2)
    edges = rng.permutation(np.concatenate([along_x, along_y]))
    group, tree, others = np.arange(nx * ny), [], []
    for a, b in edges.tolist():
        if group[a] == group[b]:
            others.append((a, b))
            continue
        group[group == group[b]] = group[a]
        tree.append((a, b))
    flat = nodes.reshape(-1, 2)
    return [_line(flat[a], flat[b], spec, rng) for a, b in tree + others[: round(spec.loops * len(others))]]


def mine_triangles(spec: MineSpec, lines: list[Array], ground: tuple[Array, Array], rng: np.random.Generator) -> Array:
    """Walls and roof (T, 3, 3), m, about centre lines; `ground` is the height field and its corner (2,)."""
    points = np.concatenate(lines)
    low = points.min(axis=0) - spec.half_width_m[1] - _AROUND_M
    count = np.ceil((np.ptp(points, axis=0) + 2 * (spec.half_width_m[1] + _AROUND_M)) / spec.rock_cell_m).astype(int)
    high = int(np.ceil((spec.tunnel_height_m[1] + 1.5 + _BELOW_M) / spec.rock_cell_m))
    shape = (int(count[0]) + 1, int(count[1]) + 1, high + 1)
    field = _hollow(spec, points, low, shape, rng)
    triangles = skin(field, np.array([*low, -_BELOW_M]), spec.rock_cell_m)
    heights, corner = ground
    at = (triangles[..., :2].reshape(-1, 2) - corner).T / spec.cell_m
    triangles[..., 2] += ndimage.map_coordinates(heights, at, order=1, mode="nearest").reshape(-1, 3)
    return triangles


def _line(a: Array, b: Array, spec: MineSpec, rng: np.random.Generator) -> Array:
    """From a to b with a bend aside; points `_STEP_M` apart."""
    way = b - a
    t = np.linspace(0.0, 1.0, int(np.ceil(np.linalg.norm(way) / _STEP_M)) + 1)[:, None]
    aside = np.array([-way[1], way[0]]) / np.linalg.norm(way)
    bend = rng.uniform(-spec.bend_m, spec.bend_m, 2)
    return np.asarray(a + t * way + aside * (bend[0] * np.sin(np.pi * t) + 0.5 * bend[1] * np.sin(2 * np.pi * t)))


def _hollow(spec: MineSpec, points: Array, low: Array, shape: tuple[int, int, int], rng: np.random.Generator) -> Array:
    """Negative inside of the tunnels; heights count from the floor."""
    cell = spec.rock_cell_m
    x, y = (low[k] + cell * np.arange(shape[k]) for k in range(2))
    z = np.maximum(cell * np.arange(shape[2]) - _BELOW_M, 0.0)
    xy = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2)
    gap = cKDTree(points).query(xy)[0].reshape(shape[:2])
    half = _between(spec.half_width_m, shape[:2], 6.0 / cell, rng)
    top = _between(spec.tunnel_height_m, shape[:2], 6.0 / cell, rng)
    across, up = (gap / half)[..., None], z / top[..., None]
    body = (across**_ARCH + up**_ARCH) ** (1.0 / _ARCH) - 1.0
    rough = ndimage.gaussian_filter(rng.standard_normal(shape), spec.rock_length_m / cell)
    return np.asarray(body * half[..., None] + spec.rock_roughness_m * rough / max(float(rough.std()), 1e-9))


def _between(span: tuple[float, float], shape: tuple[int, int], length_cells: float, rng: np.random.Generator) -> Array:
    """A smooth random field within a span."""
    smooth = ndimage.gaussian_filter(rng.standard_normal(shape), length_cells)
    share = 0.5 + 0.25 * smooth / max(float(smooth.std()), 1e-9)
    return np.asarray(span[0] + (span[1] - span[0]) * np.clip(share, 0.0, 1.0))
