"""The ground: a slope with random bumps, as a height field over a grid of triangles."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from companion.core.messages import Array
from sim.world.spec import EmptySpec


def make_heights(spec: EmptySpec, corner_m: Array, shape: tuple[int, int], rng: np.random.Generator) -> Array:
    """Heights (nx, ny) at corner + (i, j) * cell, m; any level.

    Bumps are white noise through a Gaussian of `roughness_length_m`, plus a third of it at
    a quarter of the length, scaled to an rms of `roughness_m`.
    """
    noise = rng.standard_normal(shape)
    bumps = _smooth(noise, spec.roughness_length_m / spec.cell_m)
    bumps += 0.33 * _smooth(noise, 0.25 * spec.roughness_length_m / spec.cell_m)
    bumps *= spec.roughness_m / max(float(bumps.std()), 1e-9)
    x = corner_m[0] + spec.cell_m * np.arange(shape[0])[:, None]
    y = corner_m[1] + spec.cell_m * np.arange(shape[1])[None, :]
    heading = math.radians(spec.slope_heading_deg)
    rise = math.tan(math.radians(spec.slope_deg))
    return np.asarray(bumps + rise * (x * math.cos(heading) + y * math.sin(heading)))


def _smooth(noise: Array, length_cells: float) -> Array:
    """Periodic Gaussian filter of unit variance; `length_cells` is about half a wavelength."""
    fx = np.fft.fftfreq(noise.shape[0])[:, None]
    fy = np.fft.rfftfreq(noise.shape[1])[None, :]
    gain = np.exp(-0.5 * (math.pi * length_cells) ** 2 * (fx**2 + fy**2))
    gain[0, 0] = 0.0
    field = np.fft.irfft2(np.fft.rfft2(noise) * gain, s=noise.shape)
    return np.asarray(field / max(float(field.std()), 1e-9))


def heights_at(heights: Array, origin_xy: Array, cell_m: float, xy: Array) -> Array:
    """Ground height (N,) at points (N, 2), on the very triangles of the mesh; clamped at the rim."""
    out = np.empty(len(xy))
    _heights_at(heights, origin_xy, cell_m, np.ascontiguousarray(xy, dtype=np.float64), out)
    return out


@njit(cache=True, nogil=True)
def _heights_at(heights, origin_xy, cell_m, xy, out):  # type: ignore[no-untyped-def]
    for k in range(xy.shape[0]):
        out[k] = _height(heights, origin_xy, cell_m, xy[k, 0], xy[k, 1])


@njit(cache=True, nogil=True)
def _height(heights, origin_xy, cell_m, x, y):  # type: ignore[no-untyped-def]
    """Each cell is split along the diagonal from (1, 0) to (0, 1), as in mesh.ground_mesh."""
    nx, ny = heights.shape
    u = min(max((x - origin_xy[0]) / cell_m, 0.0), nx - 1.000001)
    v = min(max((y - origin_xy[1]) / cell_m, 0.0), ny - 1.000001)
    i, j = int(u), int(v)
    fu, fv = u - i, v - j
    h10, h01 = heights[i + 1, j], heights[i, j + 1]
    if fu + fv <= 1.0:
        h00 = heights[i, j]
        return h00 + fu * (h10 - h00) + fv * (h01 - h00)
    h11 = heights[i + 1, j + 1]
    return h11 + (1.0 - fu) * (h01 - h11) + (1.0 - fv) * (h10 - h11)
