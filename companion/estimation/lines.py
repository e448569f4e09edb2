"""Point-to-line registration of edge points against a `PointMap` of edge points, as normal equations for a filter.

Source: J. Zhang and S. Singh, "LOAM", RSS 2014, sec. V-B and VI: a line through the five nearest edge points, if the
largest eigenvalue of their scatter is far above the second. The residual is the vector from the line to the point,
which has two components across it; weights after Cauchy.
"""

from __future__ import annotations

from typing import Annotated

import msgspec
import numpy as np
from numba import njit

from companion.core.messages import Array
from companion.estimation.nearest_registration import NearestRegistration
from companion.estimation.point_map import PointMap
from companion.estimation.registration import Flags, nearest_five
from companion.estimation.so3 import multiply_into

Positive = Annotated[float, msgspec.Meta(gt=0)]


class LineConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """How lines are found and how far they are trusted."""

    neighbour_m: Positive = 1.5  # the five neighbours lie within
    straightness_m: Positive = 0.08  # and this close to their line
    elongation: Annotated[float, msgspec.Meta(ge=1)] = 9.0  # largest over second eigenvalue of their scatter, at least
    sigma_m: Positive = 0.04  # of a point across its line
    cauchy: Positive = 4.0  # squared normalised residual that halves the square root of the weight
    inflation: Positive = 3.0  # neighbouring points are not independent: information is divided by it
    gate_m: Positive = 0.5  # residual, at most
    search_again_m: Annotated[float, msgspec.Meta(ge=0)] = 0.03  # motion that makes neighbours stale


class LineRegistration(NearestRegistration):
    """Edge points against lines of a map of edges."""

    def __init__(self, target: PointMap, points_body: Array, config: LineConfig) -> None:
        super().__init__(points_body, numbers=6, inflation=config.inflation, search_again_m=config.search_again_m)
        self._map, self._config = target, config

    def find(self, R: Array, p: Array) -> None:
        """Lines at the pose."""
        find_lines(self._map, self.points, R, p, self._config, self.met, self.valid)

    def add(self, R: Array, p: Array, H: Array, g: Array) -> int:
        """Of points against their lines."""
        c = self._config
        limits = (1.0 / c.sigma_m**2, c.cauchy, c.gate_m)
        return int(_linearise(self.points, R, p, self.met, self.valid, limits, H, g))

    def off_m(self, R: Array, p: Array) -> Array:
        """Across the lines."""
        off = self.points @ R.T + p - self.met[:, :3]
        along = (off * self.met[:, 3:]).sum(axis=1)
        return np.asarray(np.sqrt(np.maximum((off**2).sum(axis=1) - along**2, 0.0)))


def find_lines(
    target: PointMap, points: Array, R: Array, p: Array, config: LineConfig, lines: Array, valid: Flags
) -> int:
    """Middle and unit direction of the five map points nearest to each R @ point + p, into `lines` (N, 6).

    `valid` (N,) says where there is one; returns how many.
    """
    store = (target.keys, target.value, target.counts, target.pool)
    limits = (target.config.voxel_m, config.neighbour_m**2, config.straightness_m**2, config.elongation)
    return int(_find_lines(store, points, R, p, limits, lines, valid))


@njit(cache=True, nogil=True)
def _find_lines(store, points, R, p, limits, lines, valid):  # type: ignore[no-untyped-def]
    near, line, used = np.empty((points.shape[0], 5, 3)), np.empty(6), 0
    nearest_five(store, points, R, p, limits, near, valid)
    for q in range(points.shape[0]):
        valid[q] = valid[q] and _fit_line(near[q], limits[2], limits[3], line)
        if valid[q]:
            lines[q] = line
            used += 1
    return used


@njit(cache=True, nogil=True)
def _fit_line(near, straight2, elongation, line):  # type: ignore[no-untyped-def]
    """Largest eigenvector of the scatter, by squaring it: the others fade with the eigenvalues' ratio^16."""
    mean, S = np.zeros(3), np.zeros((3, 3))
    for u in range(5):
        for i in range(3):
            mean[i] += near[u, i] / 5.0
    for u in range(5):
        for i in range(3):
            for j in range(3):
                S[i, j] += (near[u, i] - mean[i]) * (near[u, j] - mean[j])
    trace = S[0, 0] + S[1, 1] + S[2, 2]
    if trace < 1e-9:
        return False
    M, square = S / trace, np.empty((3, 3))
    for _ in range(4):
        multiply_into(M, M, square)
        M[:] = square / (square[0, 0] + square[1, 1] + square[2, 2])
    k = 0 if M[0, 0] >= M[1, 1] and M[0, 0] >= M[2, 2] else (1 if M[1, 1] >= M[2, 2] else 2)
    d = M[k] / np.sqrt(M[k, 0] ** 2 + M[k, 1] ** 2 + M[k, 2] ** 2)  # a row is a column, too
    largest = 0.0
    for i in range(3):
        largest += d[i] * (S[i, 0] * d[0] + S[i, 1] * d[1] + S[i, 2] * d[2])
    if largest < elongation * _second(S, trace, largest):
        return False
    line[:3], line[3:] = mean, d
    for u in range(5):
        x, y, z = near[u, 0] - mean[0], near[u, 1] - mean[1], near[u, 2] - mean[2]
        if x * x + y * y + z * z - (x * d[0] + y * d[1] + z * d[2]) ** 2 > straight2:
            return False
    return True


@njit(cache=True, nogil=True)
def _second(S, trace, largest):  # type: ignore[no-untyped-def]
    """The middle eigenvalue: the sum of the smaller two is the trace's, their product that of the principal minors."""
    minors = S[0, 0] * S[1, 1] - S[0, 1] ** 2 + S[0, 0] * S[2, 2] - S[0, 2] ** 2 + S[1, 1] * S[2, 2] - S[1, 2] ** 2
    total = trace - largest
    product = minors - largest * total
    return 0.5 * (total + np.sqrt(max(total * total - 4.0 * product, 0.0)))


@njit(cache=True, nogil=True)
def _linearise(points, R, p, lines, valid, limits, H, g):  # type: ignore[no-untyped-def]
    """Residual r = A (R x + p - m) with A = I - d d'; J = A B, B = (-R [x]x, I); as A A = A, J'J = B'A B, J'r = B'r."""
    information, cauchy, gate = limits
    B, r, d = np.empty((3, 6)), np.empty(3), np.empty(3)
    along = np.empty(6)
    H[:], g[:] = 0.0, 0.0
    used = 0
    for q in range(points.shape[0]):
        if not valid[q]:
            continue
        a, b, c = points[q, 0], points[q, 1], points[q, 2]
        for i in range(3):
            d[i] = lines[q, 3 + i]
            r[i] = R[i, 0] * a + R[i, 1] * b + R[i, 2] * c + p[i] - lines[q, i]
        way = d[0] * r[0] + d[1] * r[1] + d[2] * r[2]
        for i in range(3):
            r[i] -= way * d[i]
            B[i, 0], B[i, 1], B[i, 2] = R[i, 2] * b - R[i, 1] * c, R[i, 0] * c - R[i, 2] * a, R[i, 1] * a - R[i, 0] * b
            B[i, 3], B[i, 4], B[i, 5] = 0.0, 0.0, 0.0
            B[i, 3 + i] = 1.0
        r2 = r[0] * r[0] + r[1] * r[1] + r[2] * r[2]
        if r2 > gate * gate:
            continue
        root = cauchy / (cauchy + r2 * information)
        weight = root * root * information
        for i in range(6):
            along[i] = d[0] * B[0, i] + d[1] * B[1, i] + d[2] * B[2, i]
        for i in range(6):
            g[i] -= weight * (B[0, i] * r[0] + B[1, i] * r[1] + B[2, i] * r[2])
            for j in range(i, 6):
                square = B[0, i] * B[0, j] + B[1, i] * B[1, j] + B[2, i] * B[2, j]
                H[i, j] += weight * (square - along[i] * along[j])
        used += 1
    for i in range(6):
        for j in range(i):
            H[i, j] = H[j, i]
    return used
