"""Points of sweeps against planes whose points come from a fixed map and from earlier sweeps of the same window.

A plane goes through the five points nearest to where a point lies now. Those of the map are fixed; those of a sweep
move with the pose of its node, and the plane with them: by the share of the five that are its own. So a point on new
ground ties two poses to each other, one on old ground ties its pose to the map, and none does both in full: each point
counts once. Planes are fitted anew at each linearisation, and searched anew when poses have moved.

Source: the residual is that of W. Xu et al., "FAST-LIO2", T-RO 2022, sec. V; of several sweeps as in Z. Liu and
F. Zhang, "BALM", RA-L 2021, with few points per plane instead of all.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numba import njit
from numpy.typing import NDArray

from companion.core.messages import Array, Array32
from companion.estimation.point_map import PointMap
from companion.estimation.registration import _ORDER, PlaneConfig, _fit_plane, nearest_five
from companion.estimation.voxels import pack, slot_of
from companion.estimation.window.fresh_points import FreshPoints

_FIXED = -1
_SPREAD = 1.4826  # of a normal distribution, over the median of its magnitude
_SUPPORT = 0.4  # variance of a plane through five single returns, about where it is asked, over that of one return
_COARSEST = 15.0  # times `sigma_m`, of a sweep far off


@dataclass(slots=True)
class Sweep:
    """Points of one node, body frame, and what they met."""

    points: Array  # (N, 3), few, to be registered
    spaced: Array32  # (M, 3), more, for the map
    fresh: Array = field(default_factory=lambda: np.empty((0, 3)))  # (K, 3), of the spaced that the map lacks
    near: Array = field(init=False)  # (N, 5, 3): in odom if of the map, else in the body frame of the owner
    owner: NDArray[np.int64] = field(init=False)  # (N, 5): node, or `_FIXED`
    valid: NDArray[np.bool_] = field(init=False)  # (N,)
    planes: Array = field(init=False)  # (N, 4)
    searched: tuple[Array, Array] | None = None
    used: int = 0
    sigma_m: float = 0.0  # of its points, as they lay at the last linearisation

    def __post_init__(self) -> None:
        count = len(self.points)
        self.near, self.planes = np.empty((count, 5, 3)), np.empty((count, 4))
        self.owner, self.valid = np.full((count, 5), _FIXED), np.zeros(count, np.bool_)

    def is_stale(self, R: Array, p: Array, beyond_m: float) -> bool:
        """Whether the pose has moved since the search."""
        if self.searched is None:
            return True
        moved = np.linalg.norm(p - self.searched[1]) + 3.0 * np.linalg.norm(R - self.searched[0])
        return bool(moved > beyond_m)

    def freeze(self, owner: int, R: Array, p: Array) -> None:
        """What `owner` has seen is fixed from now on, at the pose (R, p)."""
        own = self.owner == owner
        self.near[own] = self.near[own] @ R.T + p
        self.owner[own] = _FIXED


def associate(sweep: Sweep, target: PointMap, fresh: FreshPoints, pose: tuple[Array, Array], c: PlaneConfig) -> None:
    """Search the five nearest of map and fresh points at the pose (R_odom_body, p_odom)."""
    R, p = pose
    sweep.near.fill(np.inf)
    store = (target.keys, target.value, target.counts, target.pool)
    nearest_five(store, sweep.points, R, p, (target.config.voxel_m, c.neighbour_m**2), sweep.near, sweep.valid)
    sweep.owner.fill(_FIXED)
    _complete(fresh.store, sweep.points, R, p, fresh.voxel_m, c.neighbour_m**2, sweep.near, sweep.owner)
    sweep.searched = R.copy(), p.copy()


def linearise(sweep: Sweep, k: int, poses: tuple[Array, Array], first: int, c: PlaneConfig) -> tuple[Array, Array]:
    """Normal equations of the sweep of pose k, by all poses (theta_body, p_odom): H (6n, 6n) and g (6n,).

    `poses` are rotations (n, 3, 3) and positions (n, 3) of nodes `first` and on. The noise of the points is taken from
    how they lie, if that is worse than `c.sigma_m`: a sweep that is far off pulls from afar, and says little.
    """
    r, n = np.empty(len(sweep.points)), len(poses[0])
    planar = c.flatness_m, 5.0 * c.breadth_m**2
    _place_planes(sweep.points, (*poses, k, first), sweep.near, sweep.owner, planar, sweep.planes, r)
    seen = np.abs(r[np.isfinite(r)])
    spread = _SPREAD * float(np.median(seen)) if len(seen) else 0.0
    sweep.sigma_m = min(max(spread, c.sigma_m), _COARSEST * c.sigma_m)
    H, g = np.zeros((6 * n, 6 * n)), np.zeros(6 * n)
    limits = 1.0 / sweep.sigma_m**2, c.cauchy, c.range_gate * sweep.sigma_m / c.sigma_m
    sweep.used = int(_accumulate(sweep.points, (*poses, k, first), sweep.owner, sweep.planes, r, limits, H, g))
    return H / c.inflation, g / c.inflation


@njit(cache=True, nogil=True)
def _complete(store, points, R, p, voxel_m, most2, near, owner):  # type: ignore[no-untyped-def]
    """Fresh points that are nearer than the five found in the map take their places."""
    keys, first, counts, pool, bodies, odom, owners = store
    near2 = np.empty(5)
    for q in range(points.shape[0]):
        a, b, c = points[q, 0], points[q, 1], points[q, 2]
        x = R[0, 0] * a + R[0, 1] * b + R[0, 2] * c + p[0]
        y = R[1, 0] * a + R[1, 1] * b + R[1, 2] * c + p[1]
        z = R[2, 0] * a + R[2, 1] * b + R[2, 2] * c + p[2]
        for u in range(5):
            d = (near[q, u, 0] - x) ** 2 + (near[q, u, 1] - y) ** 2 + (near[q, u, 2] - z) ** 2
            near2[u] = min(d, most2)
        i0, j0, k0 = np.int64(np.floor(x / voxel_m)), np.int64(np.floor(y / voxel_m)), np.int64(np.floor(z / voxel_m))
        gx, gy, gz = x - i0 * voxel_m, y - j0 * voxel_m, z - k0 * voxel_m
        si = -1 if 2.0 * gx < voxel_m else 1  # the nearer side
        sj = -1 if 2.0 * gy < voxel_m else 1
        sk = -1 if 2.0 * gz < voxel_m else 1
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
            v = first[s]
            for u in range(counts[v]):
                m = pool[v, u]
                d = (odom[m, 0] - x) ** 2 + (odom[m, 1] - y) ** 2 + (odom[m, 2] - z) ** 2
                if d >= near2[4]:
                    continue
                w = 4
                while w > 0 and near2[w - 1] > d:
                    near2[w], owner[q, w] = near2[w - 1], owner[q, w - 1]
                    for i in range(3):
                        near[q, w, i] = near[q, w - 1, i]
                    w -= 1
                near2[w], owner[q, w] = d, owners[m]
                for i in range(3):
                    near[q, w, i] = bodies[m, i]


@njit(cache=True, nogil=True)
def _place_planes(points, poses, near, owner, limits, planes, r):  # type: ignore[no-untyped-def]
    """Planes (N, 4) in odom where their points lie now, and residuals r (N,), NaN where there is no plane."""
    R, p, k, first = poses
    five, plane = np.empty((5, 3)), np.empty(4)
    for q in range(points.shape[0]):
        r[q] = np.nan
        if not np.isfinite(near[q, 4, 0]):
            continue
        for u in range(5):
            j = owner[q, u] - first
            for i in range(3):
                if owner[q, u] < 0:
                    five[u, i] = near[q, u, i]
                else:
                    five[u, i] = p[j, i]
                    for m in range(3):
                        five[u, i] += R[j, i, m] * near[q, u, m]
        if not _fit_plane(five, limits[0], limits[1], plane):
            continue
        r[q] = plane[3]
        for i in range(3):
            x = p[k, i]
            for m in range(3):
                x += R[k, i, m] * points[q, m]
            r[q] += plane[i] * x
        for i in range(4):
            planes[q, i] = plane[i]


@njit(cache=True, nogil=True)
def _accumulate(points, poses, owner, planes, r, limits, H, g):  # type: ignore[no-untyped-def]
    """H and g of r = n.(R x + p) + d, where a plane moves with each owner by its share of the five points.

    As part of an owner's body it moves as its point next to x does, so the lever is that of x seen from there.
    """
    (R, _, k, _), (information, cauchy, gate) = poses, limits
    J, columns, used = np.empty((6, 6)), np.empty(6, np.int64), 0  # blocks: own pose, then up to five owners
    for q in range(points.shape[0]):
        square = points[q, 0] ** 2 + points[q, 1] ** 2 + points[q, 2] ** 2
        if not abs(r[q]) <= gate * square**0.25:  # also if it is no number
            continue
        used += 1
        columns[0] = k
        _row(points[q, 0], points[q, 1], points[q, 2], R[k], planes[q], 1.0, J[0])
        blocks = _owner_rows(points[q], poses, owner[q], planes[q], J, columns)
        moving = 0.0
        for b in range(1, blocks):
            moving -= J[b, 3] * planes[q, 0] + J[b, 4] * planes[q, 1] + J[b, 5] * planes[q, 2]
        root = cauchy / (cauchy + r[q] * r[q] * information)
        weight = root * root * information / (1.0 + _SUPPORT * moving)
        for b in range(blocks):
            for i in range(6):
                g[6 * columns[b] + i] -= weight * J[b, i] * r[q]
                for c in range(blocks):
                    for j in range(6):
                        H[6 * columns[b] + i, 6 * columns[c] + j] += weight * J[b, i] * J[c, j]
    return used


@njit(cache=True, nogil=True)
def _owner_rows(x, poses, owner, plane, J, columns):  # type: ignore[no-untyped-def]
    """Rows of the owners after the first; returns how many rows there are then."""
    R, p, k, first = poses
    y, blocks = np.empty(3), 1
    for u in range(5):
        if owner[u] < 0:
            continue
        share, is_new = 0.2, True
        for w in range(5):
            if owner[w] == owner[u] and w != u:
                share += 0.2
                is_new = is_new and w > u
        if not is_new:
            continue
        j = owner[u] - first
        for i in range(3):
            y[i] = p[k, i] - p[j, i]
            for m in range(3):
                y[i] += R[k, i, m] * x[m]
        a = R[j, 0, 0] * y[0] + R[j, 1, 0] * y[1] + R[j, 2, 0] * y[2]
        b = R[j, 0, 1] * y[0] + R[j, 1, 1] * y[1] + R[j, 2, 1] * y[2]
        c = R[j, 0, 2] * y[0] + R[j, 1, 2] * y[1] + R[j, 2, 2] * y[2]
        _row(a, b, c, R[j], plane, -share, J[blocks])
        columns[blocks] = j
        blocks += 1
    return blocks


@njit(cache=True, nogil=True)
def _row(a, b, c, R, plane, share, J):  # type: ignore[no-untyped-def]
    """share * d n.(R x + p) / d (theta_body, p) with x = (a, b, c)."""
    n0, n1, n2 = plane[0], plane[1], plane[2]
    u0 = R[0, 0] * n0 + R[1, 0] * n1 + R[2, 0] * n2
    u1 = R[0, 1] * n0 + R[1, 1] * n1 + R[2, 1] * n2
    u2 = R[0, 2] * n0 + R[1, 2] * n1 + R[2, 2] * n2
    J[0], J[1], J[2] = share * (b * u2 - c * u1), share * (c * u0 - a * u2), share * (a * u1 - b * u0)
    J[3], J[4], J[5] = share * n0, share * n1, share * n2
