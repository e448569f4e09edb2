"""Kernels on the local map's grids. Positions are in cells from the map's corner, not rounded."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

JUMP_UNIT = 16  # steps of a jump per cell
WINDOW = 6  # cells around a column whose bands bound a jump
_FARTHEST_JUMP = 5.0  # cells


@njit(cache=True, nogil=True)
def sample_field(field, cells):  # type: ignore[no-untyped-def]
    """Trilinear values (N,) of a field (X, Y, Z) at cells (N, 3)."""
    values, gradient = np.empty(cells.shape[0]), np.empty(3)
    for n in range(cells.shape[0]):
        values[n] = trilinear(field, cells[n], gradient)
    return values


@njit(cache=True, nogil=True)
def trilinear(field, cell, gradient):  # type: ignore[no-untyped-def]
    """Value at `cell` (3,); writes its gradient per cell (3,). Clamped to the outermost centres."""
    i, a = _split(cell[0], field.shape[0])
    j, b = _split(cell[1], field.shape[1])
    k, c = _split(cell[2], field.shape[2])
    v000, v001 = float(field[i, j, k]), float(field[i, j, k + 1])
    v010, v011 = float(field[i, j + 1, k]), float(field[i, j + 1, k + 1])
    v100, v101 = float(field[i + 1, j, k]), float(field[i + 1, j, k + 1])
    v110, v111 = float(field[i + 1, j + 1, k]), float(field[i + 1, j + 1, k + 1])
    v00, v01 = v000 + a * (v100 - v000), v001 + a * (v101 - v001)
    v10, v11 = v010 + a * (v110 - v010), v011 + a * (v111 - v011)
    v0, v1 = v00 + b * (v10 - v00), v01 + b * (v11 - v01)
    dx0 = (v100 - v000) * (1 - b) + (v110 - v010) * b
    dx1 = (v101 - v001) * (1 - b) + (v111 - v011) * b
    gradient[0] = dx0 * (1 - c) + dx1 * c
    gradient[1] = (v10 - v00) * (1 - c) + (v11 - v01) * c
    gradient[2] = v1 - v0
    return v0 + c * (v1 - v0)


@njit(cache=True, nogil=True)
def _split(x, count):  # type: ignore[no-untyped-def]
    """Lower neighbour and the part beyond it, for cell centres at n + 0.5."""
    x = min(max(x - 0.5, 0.0), count - 1.000001)
    i = int(x)
    return i, x - i


@njit(cache=True, nogil=True)
def segment_free(steps, p, q):  # type: ignore[no-untyped-def]
    """True if the segment p..q (cells) meets no blocked cell and stays in the grid."""
    nx, ny, nz = steps.shape
    dx, dy, dz = q[0] - p[0], q[1] - p[1], q[2] - p[2]
    total = math.sqrt(dx * dx + dy * dy + dz * dz)
    inverse = 1.0 / total if total > 1e-12 else 0.0
    dx, dy, dz = dx * inverse, dy * inverse, dz * inverse
    t = 0.0
    while True:
        t = min(t, total)
        x, y, z = p[0] + dx * t, p[1] + dy * t, p[2] + dz * t
        i, j, k = math.floor(x), math.floor(y), math.floor(z)
        if i < 0 or j < 0 or k < 0 or i >= nx or j >= ny or k >= nz:
            return False
        step = steps[i, j, k]
        if step == 0:
            return False
        if t >= total:
            return True
        if step > 1:
            t += (step - 1) / JUMP_UNIT
        else:
            leave = min(_to_border(x, i, dx), _to_border(y, j, dy), _to_border(z, k, dz))
            t += max(leave, 0.0) + 1e-7


@njit(cache=True, nogil=True)
def path_free(steps, cells):  # type: ignore[no-untyped-def]
    """True if no segment of the polyline (N, 3) meets a blocked cell or leaves the grid."""
    clear = True
    for n in range(cells.shape[0] - 1):
        clear = clear and segment_free(steps, cells[n], cells[n + 1])
    return clear


@njit(cache=True, nogil=True)
def _to_border(x, i, d):  # type: ignore[no-untyped-def]
    if d > 1e-12:
        return (i + 1 - x) / d
    if d < -1e-12:
        return (i - x) / d
    return 1e30


@njit(cache=True, nogil=True)
def build_steps(field, bands, radius_m, resolution_m, steps):  # type: ignore[no-untyped-def]
    """Blocked cells and safe jumps; `bands` = (low, high) of each column, (low, high) near it.

    Cells of two points t apart have centres at most t + sqrt(3) cells apart, and the field
    falls by at most one cell per cell: hence the jump (d - radius) - sqrt(3), in cells.
    """
    low, high, near_low, near_high = bands
    nx, ny = low.shape
    scale = np.float32(JUMP_UNIT / resolution_m)
    radius = np.float32(radius_m - 1e-4)
    loss = np.float32(JUMP_UNIT * math.sqrt(3.0))
    for i in range(nx):
        for j in range(ny):
            first, last = low[i, j], high[i, j]
            steps[i, j, :] = 0
            if first <= last:
                above, below = np.int32(first - near_low[i, j] - 1), np.int32(near_high[i, j] - 1 - first)
                _build_column(
                    field[i, j, first : last + 1], steps[i, j, first : last + 1], (radius, scale, loss), above, below
                )


@njit(cache=True, nogil=True)
def _build_column(field, steps, units, above, below):  # type: ignore[no-untyped-def]
    """`above`, `below`: cells from the first to the borders that bound a jump. No branch, so it is vectorised."""
    radius, scale, loss = units
    most, zero, unit = np.float32(JUMP_UNIT * _FARTHEST_JUMP), np.float32(0.0), np.float32(JUMP_UNIT)
    for k in range(len(field)):
        d = field[k] - radius
        room = np.float32(min(above + np.int32(k), below - np.int32(k))) * unit
        jump = max(min(min(d * scale - loss, room), most), zero)
        steps[k] = np.uint8(np.int32(jump) + np.int32(1)) if d >= zero else np.uint8(0)


@njit(cache=True, nogil=True)
def fill_nearest(ground, gap):  # type: ignore[no-untyped-def]
    """Replace NaN by the value of the (about) nearest cell that has one: two chamfer sweeps.

    `gap` (X + 2, Y + 2) is scratch; its rim is infinitely far, so that no neighbour is out of bounds.
    """
    nx, ny = ground.shape
    gap[:] = np.float32(1e9)
    for i in range(nx):
        for j in range(ny):
            if not np.isnan(ground[i, j]):
                gap[i + 1, j + 1] = np.float32(0.0)
    for side in (-1, 1):
        for a in range(nx):
            i = a if side < 0 else nx - 1 - a
            for b in range(ny):
                j = b if side < 0 else ny - 1 - b
                if gap[i + 1, j + 1] > np.float32(0.0):
                    _take_nearest(ground, gap, i, j, side)


@njit(cache=True, nogil=True)
def _take_nearest(ground, gap, i, j, side):  # type: ignore[no-untyped-def]
    """Cell (i, j) takes the value of that of four neighbours which knows a nearer one, the first of equals."""
    best, m, n = gap[i + 1, j + 1], i, j
    for di, dj, way in ((0, side, 1.0), (side, -1, 1.414), (side, 0, 1.0), (side, 1, 1.414)):
        through = gap[i + 1 + di, j + 1 + dj] + np.float32(way)
        if through < best:
            best, m, n = through, i + di, j + dj
    gap[i + 1, j + 1], ground[i, j] = best, ground[m, n]


@njit(cache=True, nogil=True)
def first_unknown(state, cells, ways, radii, most_share):  # type: ignore[no-untyped-def]
    """Index of the first of `cells` (N, 3) whose surroundings ahead are not known free; N: none.

    `ways` (N, 3) are unit directions of motion; `radii` = (outer, inner) in cells. In the
    outer half ball ahead at most `most_share` of the cells may be unknown, in the inner none.
    Cells outside the grid are unknown.
    """
    outer, inner = radii
    reach = math.ceil(outer)
    for n in range(cells.shape[0]):
        c0, c1, c2 = math.floor(cells[n, 0]), math.floor(cells[n, 1]), math.floor(cells[n, 2])
        seen, unknown = 0, 0
        for i in range(c0 - reach, c0 + reach + 1):
            for j in range(c1 - reach, c1 + reach + 1):
                for k in range(c2 - reach, c2 + reach + 1):
                    dx, dy, dz = i + 0.5 - cells[n, 0], j + 0.5 - cells[n, 1], k + 0.5 - cells[n, 2]
                    far2 = dx * dx + dy * dy + dz * dz
                    if far2 > outer * outer or dx * ways[n, 0] + dy * ways[n, 1] + dz * ways[n, 2] < 0.0:
                        continue
                    seen += 1
                    inside = 0 <= i < state.shape[0] and 0 <= j < state.shape[1] and 0 <= k < state.shape[2]
                    if not inside or state[i, j, k] == 0:
                        unknown += 1
                        if far2 <= inner * inner:
                            return n
        if unknown > most_share * seen:
            return n
    return cells.shape[0]
