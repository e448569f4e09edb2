"""Voxels drawn without meshes: each is the same small picture of a cube, put into a depth buffer.

In a parallel projection all cubes look alike, so the cube is cast once. Edges are darkened where a
neighbouring pixel is nearer. Source: C. Boucheny, "Visualisation scientifique de grands volumes de
données" (eye-dome lighting), 2009.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from companion.core.messages import Array

_LIGHT = (0.80, 0.62, 1.0)  # of faces across x, y, z
_DEPTH_STEP_M = 1e-3
_INDEX_BITS, _FACE_BITS = 32, 2
_EDGE_REACH = (1, 2, 4)  # pixels
_EDGE_STRENGTH = 0.28
_LARGEST_CUBE = 40  # pixels


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """A parallel projection. `azimuth`: where the camera looks, from east to north; `elevation`: how far down; rad."""

    azimuth: float
    elevation: float

    @property
    def axes(self) -> Array:
        """Rows: to the right in the picture, up in it, and away from the camera (3, 3)."""
        ca, sa, ce, se = (f(v) for v in (self.azimuth, self.elevation) for f in (math.cos, math.sin))
        return np.array([[sa, -ca, 0.0], [ca * se, sa * se, ce], [ca * ce, sa * ce, -se]])


OBLIQUE = View(math.radians(62.0), math.radians(32.0))
ABOVE = View(math.radians(90.0), math.radians(90.0))
NORTHWARD = View(math.radians(90.0), 0.0)


@dataclass(frozen=True, slots=True, eq=False)
class Picture:
    """`rgba` (H, W, 4) in 0 .. 1; `extent`: left, right, bottom, top, m along the picture."""

    rgba: Array
    extent: tuple[float, float, float, float]


def render(centers: Array, colors: Array, edge_m: float, view: View, width_px: int) -> Picture:
    """The cubes at `centers` (N, 3), of `edge_m`, in `colors` (N, 3) of 0 .. 1; N > 0."""
    placed = centers @ view.axes.T
    half = edge_m * 0.5 * np.abs(view.axes).sum(axis=1)[:2].max()
    low, high = placed[:, :2].min(axis=0) - half, placed[:, :2].max(axis=0) + half
    per_m = min(width_px / float(high[0] - low[0]), _LARGEST_CUBE / edge_m)
    shape = tuple(int(n) for n in np.ceil((high - low) * per_m)[::-1])
    pixel = np.floor((placed[:, :2] - low) * per_m).astype(np.int64)
    depth = placed[:, 2] - placed[:, 2].min() + edge_m
    cube = _cube(edge_m, view, per_m)
    light = np.array(_LIGHT) / max(_LIGHT[int(face)] for face in cube[:, 3])  # the brightest face seen is full
    rgba = _shade(_fill(shape, pixel, depth, cube), colors, light, edge_m)
    extent = (float(low[0]), float(low[0]) + shape[1] / per_m, float(low[1]), float(low[1]) + shape[0] / per_m)
    return Picture(rgba[::-1], extent)


def _cube(edge_m: float, view: View, per_m: float) -> Array:
    """Pixels (K, 4) of one cube about its centre: right, up, depth in m, and face 0 .. 2.

    Half a pixel wider than the cube, so that neighbours leave no gap.
    """
    half = edge_m / 2 + 0.5 / per_m
    reach = math.ceil(half * 2.0 * per_m)
    right, up = (a.ravel() for a in np.meshgrid(*[np.arange(-reach, reach + 1)] * 2))
    origin = np.stack([right, up], axis=1) / per_m @ view.axes[:2]
    direction = np.where(np.abs(view.axes[2]) < 1e-9, 1e-9, view.axes[2])
    near = (-np.sign(direction) * half - origin) / direction
    far = (np.sign(direction) * half - origin) / direction
    enter = near.max(axis=1)
    hit = enter <= far.min(axis=1)
    return np.asarray(np.stack([right, up, enter, near.argmax(axis=1)], axis=1)[hit])


def _fill(shape: tuple[int, ...], pixel: NDArray[np.int64], depth: Array, cube: Array) -> NDArray[np.int64]:
    """The nearest face per pixel (H, W), as nearness | number of the voxel | face; 0: none."""
    buffer = np.zeros(shape, np.int64)
    flat, number = buffer.reshape(-1), np.arange(len(depth), dtype=np.int64) << _FACE_BITS
    farthest = int(depth.max() / _DEPTH_STEP_M) + 10**7
    for right, up, offset, face in cube:
        x, y = pixel[:, 0] + int(right), pixel[:, 1] + int(up)
        inside = (x >= 0) & (x < shape[1]) & (y >= 0) & (y < shape[0])
        nearness = farthest - np.rint((depth + offset) / _DEPTH_STEP_M).astype(np.int64)
        key = nearness << (_INDEX_BITS + _FACE_BITS) | number | int(face)
        np.maximum.at(flat, (y * shape[1] + x)[inside], key[inside])
    return buffer


def _shade(buffer: NDArray[np.int64], colors: Array, light: Array, edge_m: float) -> Array:
    """Colour (H, W, 4) of each pixel: that of its voxel, by the light (3,) on the face, darker behind edges."""
    drawn = buffer > 0
    number = (buffer >> _FACE_BITS) & ((1 << _INDEX_BITS) - 1)
    nearness = (buffer >> (_INDEX_BITS + _FACE_BITS)) * _DEPTH_STEP_M
    lit = light[buffer & ((1 << _FACE_BITS) - 1)] * _behind_edges(np.asarray(nearness, np.float64), edge_m)
    rgba = np.zeros((*buffer.shape, 4))
    rgba[drawn, :3] = colors[number[drawn]] * lit[drawn, None]
    rgba[..., 3] = drawn
    return rgba


def _behind_edges(nearness: Array, edge_m: float) -> Array:
    """Light (H, W) that is left beside nearer neighbours; a step of four voxels takes all it can."""
    shadow, count = np.zeros(nearness.shape), 0
    padded = np.pad(nearness, max(_EDGE_REACH))
    height, width = nearness.shape
    for reach in _EDGE_REACH:
        for dx, dy in ((reach, 0), (-reach, 0), (0, reach), (0, -reach)):
            y, x = max(_EDGE_REACH) + dy, max(_EDGE_REACH) + dx
            step = padded[y : y + height, x : x + width] - nearness
            shadow += np.clip(step / (4 * edge_m) - 0.25, 0.0, 1.0)
            count += 1
    return np.asarray(np.exp(-shadow * (_EDGE_STRENGTH * 12 / count)))
