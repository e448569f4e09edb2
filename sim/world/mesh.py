"""Triangles of a world for ray casting: ground, trunks, branches, leaves, walls, in this order."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from companion.core.messages import Array, Array32

GROUND, TRUNK, BRANCH, LEAF, WALL = range(5)  # classes of triangles
_SIDES = {TRUNK: 12, BRANCH: 4}


@dataclass(frozen=True, eq=False)
class Mesh:
    """A triangle soup with what a beam must know of each triangle."""

    vertices: Array32  # (V, 3), m
    triangles: NDArray[np.uint32]  # (T, 3)
    classes: NDArray[np.uint8]  # (T,)
    widths_m: Array32  # (T,), thickness of what it belongs to; inf: wider than any beam


def assemble(parts: list[Mesh]) -> Mesh:
    """Join meshes in the given order."""
    offsets = np.cumsum([0] + [len(p.vertices) for p in parts[:-1]], dtype=np.uint32)
    return Mesh(
        np.concatenate([p.vertices for p in parts]),
        np.concatenate([p.triangles + o for p, o in zip(parts, offsets, strict=True)]),
        np.concatenate([p.classes for p in parts]),
        np.concatenate([p.widths_m for p in parts]),
    )


def ground_mesh(heights: Array, origin_xy: Array, cell_m: float) -> Mesh:
    """Two triangles per cell of a height field (nx, ny), split as in terrain._height."""
    nx, ny = heights.shape
    x, y = np.meshgrid(origin_xy[0] + cell_m * np.arange(nx), origin_xy[1] + cell_m * np.arange(ny), indexing="ij")
    corner = (np.arange(nx - 1)[:, None] * ny + np.arange(ny - 1)[None, :]).ravel()
    lower = np.stack([corner, corner + ny, corner + 1], axis=1)
    upper = np.stack([corner + ny, corner + ny + 1, corner + 1], axis=1)
    vertices = np.stack([x.ravel(), y.ravel(), heights.ravel()], axis=1)
    return _mesh(vertices, np.concatenate([lower, upper]), GROUND, np.inf)


def tube_mesh(cones: Array, kind: int) -> Mesh:
    """Open tubes around cones (M, 9): base, unit axis, length, radius at base and tip.

    The polygon has the circle's area, so that fitted diameters are not biased.
    """
    sides = _SIDES[kind]
    swell = math.sqrt((2 * math.pi / sides) / math.sin(2 * math.pi / sides))
    axis = cones[:, 3:6]
    helper = np.where(np.abs(axis[:, :1]) < 0.9, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
    u = np.cross(axis, helper)
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    angle = 2 * math.pi * np.arange(sides) / sides
    v = np.cross(axis, u)
    ring = swell * (np.cos(angle)[:, None] * u[:, None] + np.sin(angle)[:, None] * v[:, None])
    base, tip = cones[:, None, :3], (cones[:, :3] + cones[:, 6:7] * axis)[:, None]
    rings = np.concatenate([base + cones[:, 7, None, None] * ring, tip + cones[:, 8, None, None] * ring], axis=1)
    i = np.arange(sides)
    j = (i + 1) % sides
    faces = np.concatenate([np.stack([i, j, i + sides], 1), np.stack([j, j + sides, i + sides], 1)])
    triangles = (2 * sides * np.arange(len(cones))[:, None, None] + faces).reshape(-1, 3)
    widths = np.repeat(cones[:, 7] + cones[:, 8], 2 * sides) if kind == BRANCH else np.inf
    return _mesh(rings.reshape(-1, 3), triangles, kind, widths)


def leaf_mesh(centers: Array, size_m: float, rng: np.random.Generator) -> Mesh:
    """One random triangle of about `size_m` around each centre (L, 3)."""
    corners = centers[:, None] + rng.normal(0.0, 0.5 * size_m, (len(centers), 3, 3))
    return _mesh(corners.reshape(-1, 3), np.arange(3 * len(centers)).reshape(-1, 3), LEAF, 0.3 * size_m)


def some_triangles(mesh: Mesh, keep: NDArray[np.bool_]) -> Mesh:
    """Those triangles (T,) of a mesh whose vertices are not shared; the others leave no trace."""
    vertices = mesh.vertices[mesh.triangles[keep]].reshape(-1, 3)
    triangles = np.arange(len(vertices), dtype=np.uint32).reshape(-1, 3)
    return Mesh(vertices, triangles, mesh.classes[keep], mesh.widths_m[keep])


def wall_mesh(corners: Array) -> Mesh:
    """Triangles (T, 3, 3) of racks, halls and rock."""
    return _mesh(corners.reshape(-1, 3), np.arange(3 * len(corners)).reshape(-1, 3), WALL, np.inf)


def _mesh(vertices: Array, triangles: NDArray[np.int64], kind: int, widths_m: Array | float) -> Mesh:
    count = len(triangles)
    widths = np.broadcast_to(np.asarray(widths_m, np.float32), (count,))
    return Mesh(
        vertices.astype(np.float32),
        triangles.astype(np.uint32).reshape(-1, 3),
        np.full(count, kind, np.uint8),
        np.ascontiguousarray(widths),
    )
