"""Point-to-plane registration against a `PointMap`, as normal equations for a filter.

Source: W. Xu et al., "FAST-LIO2", T-RO 2022, sec. V (five neighbours, plane test, range-scaled
residual test); weights after Cauchy.
"""

from __future__ import annotations

from itertools import product
from typing import Annotated

import msgspec
import numpy as np
from numba import njit
from numpy.typing import NDArray

from companion.core.messages import Array
from companion.estimation.nearest_registration import NearestRegistration
from companion.estimation.point_map import PointMap
from companion.estimation.voxels import pack, slot_of

Positive = Annotated[float, msgspec.Meta(gt=0)]
Flags = NDArray[np.bool_]


class PlaneConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """How planes are found and how far they are trusted."""

    neighbour_m: Positive = 1.5  # the five neighbours lie within
    flatness_m: Positive = 0.1  # and this close to their plane
    breadth_m: Annotated[float, msgspec.Meta(ge=0)] = 0.05  # and spread across their line by this
    sigma_m: Positive = 0.05  # of a point against its plane
    cauchy: Positive = 4.0  # squared normalised residual that halves the square root of the weight
    inflation: Positive = 3.0  # neighbouring points are not independent: information is divided by it
    range_gate: Positive = 1 / 9  # residual, m, allowed per square root of range
    search_again_m: Annotated[float, msgspec.Meta(ge=0)] = 0.03  # motion that makes neighbours stale


class PlaneRegistration(NearestRegistration):
    """Points against planes of the map."""

    def __init__(self, target: PointMap, points_body: Array, config: PlaneConfig) -> None:
        super().__init__(points_body, numbers=4, inflation=config.inflation, search_again_m=config.search_again_m)
        self._map, self._config = target, config

    def find(self, R: Array, p: Array) -> None:
        """Planes at the pose."""
        find_planes(self._map, self.points, R, p, self._config, self.met, self.valid)

    def add(self, R: Array, p: Array, H: Array, g: Array) -> int:
        """Of points against their planes."""
        c = self._config
        limits = (1.0 / c.sigma_m**2, c.cauchy, c.range_gate)
        return int(_linearise(self.points, R, p, self.met, self.valid, limits, H, g))

    def off_m(self, R: Array, p: Array) -> Array:
        """From the planes."""
        off: Array = np.abs((self.met[:, :3] * (self.points @ R.T + p)).sum(axis=1) + self.met[:, 3])
        return off


def find_planes(
    target: PointMap,
    points: Array,
    R: Array,
    p: Array,
    config: PlaneConfig,
    planes: Array,
    valid: Flags,
) -> int:
    """Plane n.x + d = 0 of the five map points nearest to each R @ point + p, into `planes` (N, 4).

    `valid` (N,) says where there is one; returns how many.
    """
    store = (target.keys, target.value, target.counts, target.pool)
    limits = (target.config.voxel_m, config.neighbour_m**2, config.flatness_m, 5.0 * config.breadth_m**2)
    return int(_find_planes(store, points, R, p, limits, planes, valid))


@njit(cache=True, nogil=True)
def _find_planes(store, points, R, p, limits, planes, valid):  # type: ignore[no-untyped-def]
    near, plane, used = np.empty((points.shape[0], 5, 3)), np.empty(4), 0
    nearest_five(store, points, R, p, limits, near, valid)
    for q in range(points.shape[0]):
        valid[q] = valid[q] and _fit_plane(near[q], limits[2], limits[3], plane)
        if valid[q]:
            for i in range(4):
                planes[q, i] = plane[i]
            used += 1
    return used


def _nearest_first() -> NDArray[np.int8]:
    """The 27 voxels about a point, (27, 3): per axis 0 its own, 1 the one on the nearer side, 2 the other.

    In the order of the squared distance to be expected, in quarters of a voxel: 0, 1 and 3 from the face.
    """
    away = (0, 1, 9)
    return np.array(sorted(product(range(3), repeat=3), key=lambda v: sum(away[side] for side in v)), np.int8)


_ORDER = _nearest_first()


@njit(cache=True, nogil=True)
def nearest_five(store, points, R, p, limits, near, valid):  # type: ignore[no-untyped-def]
    """The five map points nearest to each R @ point + p, into `near` (N, 5, 3); `valid` (N,): there are so many.

    `limits` begin with the edge of a voxel and the square of how far they may be. Of the 27 voxels around a point
    nearer ones come first, and those that cannot hold a nearer point are skipped.
    """
    (keys, value, counts, pool), voxel_m, near2 = store, limits[0], np.empty(5)
    for q in range(points.shape[0]):
        a, b, c = points[q, 0], points[q, 1], points[q, 2]
        x = R[0, 0] * a + R[0, 1] * b + R[0, 2] * c + p[0]
        y = R[1, 0] * a + R[1, 1] * b + R[1, 2] * c + p[1]
        z = R[2, 0] * a + R[2, 1] * b + R[2, 2] * c + p[2]
        i0, j0, k0 = np.int64(np.floor(x / voxel_m)), np.int64(np.floor(y / voxel_m)), np.int64(np.floor(z / voxel_m))
        gx, gy, gz = x - i0 * voxel_m, y - j0 * voxel_m, z - k0 * voxel_m
        si = -1 if 2.0 * gx < voxel_m else 1  # the nearer side
        sj = -1 if 2.0 * gy < voxel_m else 1
        sk = -1 if 2.0 * gz < voxel_m else 1
        found = 0
        near2[:] = limits[1]
        for o in range(27):
            a, b, c = _ORDER[o, 0], _ORDER[o, 1], _ORDER[o, 2]
            di = 0 if a == 0 else (si if a == 1 else -si)
            dj = 0 if b == 0 else (sj if b == 1 else -sj)
            dk = 0 if c == 0 else (sk if c == 1 else -sk)
            ex = 0.0 if di == 0 else (gx if di < 0 else voxel_m - gx)
            ey = 0.0 if dj == 0 else (gy if dj < 0 else voxel_m - gy)
            ez = 0.0 if dk == 0 else (gz if dk < 0 else voxel_m - gz)
            if ex * ex + ey * ey + ez * ez >= near2[4]:
                continue
            s = slot_of(keys, pack(i0 + di, j0 + dj, k0 + dk))
            if keys[s] == 0:
                continue
            v = value[s]
            for u in range(counts[v]):
                dx, dy, dz = pool[v, u, 0] - x, pool[v, u, 1] - y, pool[v, u, 2] - z
                d = dx * dx + dy * dy + dz * dz
                if d >= near2[4]:
                    continue
                w = 4
                while w > 0 and near2[w - 1] > d:
                    near2[w] = near2[w - 1]
                    for i in range(3):
                        near[q, w, i] = near[q, w - 1, i]
                    w -= 1
                near2[w] = d
                near[q, w, 0], near[q, w, 1], near[q, w, 2] = pool[v, u, 0], pool[v, u, 1], pool[v, u, 2]
                found += 1
        valid[q] = found >= 5


@njit(cache=True, nogil=True)
def _fit_plane(near, flatness_m, breadth, plane):  # type: ignore[no-untyped-def]
    """Smallest eigenvector of the scatter: power iterations on its adjugate, a multiple of its inverse."""
    m0, m1, m2 = 0.0, 0.0, 0.0
    for u in range(5):
        m0, m1, m2 = m0 + near[u, 0] / 5, m1 + near[u, 1] / 5, m2 + near[u, 2] / 5
    c00, c11, c22, c01, c02, c12 = 1e-6, 1e-6, 1e-6, 0.0, 0.0, 0.0
    for u in range(5):
        x, y, z = near[u, 0] - m0, near[u, 1] - m1, near[u, 2] - m2
        c00, c11, c22 = c00 + x * x, c11 + y * y, c22 + z * z
        c01, c02, c12 = c01 + x * y, c02 + x * z, c12 + y * z
    d00, d11, d22 = c11 * c22 - c12 * c12, c00 * c22 - c02 * c02, c00 * c11 - c01 * c01
    d01, d02, d12 = c02 * c12 - c01 * c22, c01 * c12 - c02 * c11, c01 * c02 - c00 * c12
    # Trace of the adjugate over that of the scatter: about the middle eigenvalue. Five points on
    # a line, such as a ring on the ground, have no plane, and would hold the scan where it is.
    if d00 + d11 + d22 < breadth * (c00 + c11 + c22):
        return False
    if d00 >= d11 and d00 >= d22:
        x, y, z = d00, d01, d02
    elif d11 >= d22:
        x, y, z = d01, d11, d12
    else:
        x, y, z = d02, d12, d22
    for _ in range(3):
        length = np.sqrt(x * x + y * y + z * z)
        if length < 1e-30:
            return False
        x, y, z = x / length, y / length, z / length
        x, y, z = d00 * x + d01 * y + d02 * z, d01 * x + d11 * y + d12 * z, d02 * x + d12 * y + d22 * z
    length = np.sqrt(x * x + y * y + z * z)
    if length < 1e-30:
        return False
    plane[0], plane[1], plane[2] = x / length, y / length, z / length
    plane[3] = -(plane[0] * m0 + plane[1] * m1 + plane[2] * m2)
    for u in range(5):
        off = plane[0] * near[u, 0] + plane[1] * near[u, 1] + plane[2] * near[u, 2] + plane[3]
        if abs(off) > flatness_m:
            return False
    return True


@njit(cache=True, nogil=True)
def _linearise(points, R, p, planes, valid, limits, H, g):  # type: ignore[no-untyped-def]
    """Residual r = n.(R x + p) + d; dr/dtheta = x cross R'n, dr/dp = n."""
    information, cauchy, range_gate = limits
    J = np.empty(6)
    H[:], g[:] = 0.0, 0.0
    used = 0
    for q in range(points.shape[0]):
        if not valid[q]:
            continue
        a, b, c = points[q, 0], points[q, 1], points[q, 2]
        n0, n1, n2 = planes[q, 0], planes[q, 1], planes[q, 2]
        u0 = R[0, 0] * n0 + R[1, 0] * n1 + R[2, 0] * n2
        u1 = R[0, 1] * n0 + R[1, 1] * n1 + R[2, 1] * n2
        u2 = R[0, 2] * n0 + R[1, 2] * n1 + R[2, 2] * n2
        r = u0 * a + u1 * b + u2 * c + n0 * p[0] + n1 * p[1] + n2 * p[2] + planes[q, 3]
        if abs(r) > range_gate * (a * a + b * b + c * c) ** 0.25:
            continue
        root = cauchy / (cauchy + r * r * information)
        weight = root * root * information
        J[0], J[1], J[2] = b * u2 - c * u1, c * u0 - a * u2, a * u1 - b * u0
        J[3], J[4], J[5] = n0, n1, n2
        for i in range(6):
            g[i] -= weight * J[i] * r
            for j in range(i, 6):
                H[i, j] += weight * J[i] * J[j]
        used += 1
    for i in range(6):
        for j in range(i):
            H[i, j] = H[j, i]
    return used
