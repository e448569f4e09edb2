"""Voxels drawn without meshes: each is the same small picture of a cube, put into a depth buffer.

In a parallel projection all cubes look alike, so the cube is cast once. Edges are darkened where a
neighbouring pixel is nearer. Source: C. Boucheny, "Visualisation scientifique de grands volumes de
données" (eye-dome lighting), 2009.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from companion.core.messages import Array, Array32

_LIGHT = (0.80, 0.62, 1.0)  # of faces across x, y, z
_DEPTH_STEP_M = 1e-3
_INDEX_BITS, _FACE_BITS = 32, 2
_EDGE_REACH = (1, 2, 4)  # pixels
_EDGE_STRENGTH = 0.28
_LARGEST_CUBE = 40  # pixels
_MOST_PIXELS = 3e6


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
    """`rgba` (H, W, 4); `extent`: left, right, bottom, top, m along the picture."""

    rgba: NDArray[np.uint8]
    extent: tuple[float, float, float, float]


def render(centers: Array, colors: Array, edge_m: float, view: View, width_px: int) -> Picture:
    """The cubes at `centers` (N, 3), of `edge_m`, in `colors` (N, 3) of 0 .. 1; N > 0. At most `width_px` wide."""
    placed = centers @ view.axes.T
    half = edge_m * 0.5 * np.abs(view.axes).sum(axis=1)[:2].max()
    low, high = placed[:, :2].min(axis=0) - half, placed[:, :2].max(axis=0) + half
    wide, tall = (float(v) for v in high - low)
    per_m = min(width_px / wide, math.sqrt(_MOST_PIXELS / (wide * tall)), _LARGEST_CUBE / edge_m)
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
    steps = np.rint(cube[:, 2] / _DEPTH_STEP_M).astype(np.int64)
    stamp = np.column_stack([cube[:, :2].astype(np.int64), steps, cube[:, 3].astype(np.int64)])
    deep = np.rint(depth / _DEPTH_STEP_M).astype(np.int64)
    _stamp(buffer, pixel, int(deep.max()) + int(np.abs(steps).max()) + 1 - deep, stamp)
    return buffer


@njit(cache=True, nogil=True)
def _stamp(buffer, pixel, nearness, stamp):  # type: ignore[no-untyped-def]
    height, width = buffer.shape
    for n in range(len(pixel)):
        for k in range(len(stamp)):
            x, y = pixel[n, 0] + stamp[k, 0], pixel[n, 1] + stamp[k, 1]
            if 0 <= x < width and 0 <= y < height:
                near = nearness[n] - stamp[k, 2]
                key = near << (_INDEX_BITS + _FACE_BITS) | n << _FACE_BITS | stamp[k, 3]
                buffer[y, x] = max(buffer[y, x], key)


def _shade(buffer: NDArray[np.int64], colors: Array, light: Array, edge_m: float) -> NDArray[np.uint8]:
    """Colour (H, W, 4) of each pixel: that of its voxel, by the light (3,) on the face, darker behind edges."""
    y, x = np.nonzero(buffer)
    drawn = buffer[y, x]
    number = (drawn >> _FACE_BITS) & ((1 << _INDEX_BITS) - 1)
    lit = light[drawn & ((1 << _FACE_BITS) - 1)] * _behind_edges(buffer, edge_m)[y, x]
    rgba = np.zeros((*buffer.shape, 4), np.uint8)
    rgba[y, x, :3] = np.rint(255.0 * colors[number] * lit[:, None])
    rgba[y, x, 3] = 255
    return rgba


def _behind_edges(buffer: NDArray[np.int64], edge_m: float) -> Array32:
    """Light (H, W) that is left beside nearer neighbours; a step of five voxels takes all it can."""
    nearness = (buffer >> (_INDEX_BITS + _FACE_BITS)).astype(np.float32)
    nearness *= np.float32(_DEPTH_STEP_M / (4 * edge_m))
    shadow, margin = np.zeros_like(nearness), max(_EDGE_REACH)
    padded = np.pad(nearness, margin)
    height, width = nearness.shape
    for reach in _EDGE_REACH:
        for dx, dy in ((reach, 0), (-reach, 0), (0, reach), (0, -reach)):
            step = padded[margin + dy : margin + dy + height, margin + dx : margin + dx + width] - nearness
            step -= np.float32(0.25)
            shadow += np.clip(step, 0.0, 1.0, out=step)
    return np.asarray(np.exp(-_EDGE_STRENGTH * shadow), np.float32)
