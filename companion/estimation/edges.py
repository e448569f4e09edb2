"""Edge points of a sweep: where a scan line bends, or meets something that stands before what is behind.

Source: J. Zhang and S. Singh, "LOAM: Lidar Odometry and Mapping in Real-time", RSS 2014, sec. V-A: smoothness c of
equation (1), the largest per sector of a scan line, none at borders of what is occluded, none on surfaces along the
beam. LOAM takes lines from the sensor's rings. Our sweeps name none and a Mid-360 has none, so a line is a band of
elevation about the sensor, in the order of azimuth; where nothing returned, azimuth has a gap.
"""

from __future__ import annotations

import math
from typing import Annotated

import msgspec
import numpy as np
from numba import njit

from companion.core.messages import Array, Array32
from companion.core.rig import Mount

Positive = Annotated[float, msgspec.Meta(gt=0)]
Count = Annotated[int, msgspec.Meta(ge=1)]
_AZIMUTHS = 8192  # steps of a turn in which points are ordered: 0.04 degrees
_ROWS_APART = 2  # an edge goes on within so many lines: thin poles are not hit in each


class EdgeConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """What counts as an edge, and how many are taken."""

    line_deg: Annotated[float, msgspec.Meta(ge=0.2, le=10)] = 1.0  # height of the band that is a scan line
    neighbours: Annotated[int, msgspec.Meta(ge=1, le=20)] = 3  # on each side, that smoothness is taken over
    gap_deg: Annotated[float, msgspec.Meta(gt=0, le=20)] = 4.0  # points of a line farther apart are no neighbours
    jump_m: Positive = 0.3  # in range, from a point to the next: another thing
    smoothness: Annotated[float, msgspec.Meta(gt=0, le=1)] = 0.1  # c of an edge, at least
    sectors: Annotated[int, msgspec.Meta(ge=1, le=64)] = 8  # of a line
    per_sector: Count = 6  # edges, at most


def find_edges(points_body: Array32, mount: Mount, config: EdgeConfig) -> Array:
    """Edge points (M, 3), m, body frame, of a deskewed sweep (N, 3) in the body frame, seen from the sensor.

    Of a thing that ends within `neighbours` on both sides the middle is taken, else the point itself.
    """
    line_rad = math.radians(config.line_deg)
    rows = math.ceil(math.pi / line_rad) + 1
    seen = np.empty((len(points_body), 3))  # azimuth, elevation, range
    order, starts = np.empty(len(points_body), np.int64), np.zeros(rows + 1, np.int64)
    _lines(points_body, mount.R_body_sensor, mount.p_body, line_rad, seen, order, starts)
    out = np.empty((len(points_body), 3))
    limits = (math.radians(config.gap_deg), config.jump_m, config.smoothness, line_rad)
    counts = (config.neighbours, config.sectors, config.per_sector)
    found = _edges(points_body, seen, order, starts, limits, counts, out)
    return out[:found]


@njit(cache=True, nogil=True)
def _lines(points, R, p, line_rad, seen, order, starts):  # type: ignore[no-untyped-def]
    """Azimuth, elevation and range from the sensor; the order by line, then azimuth, by two counting sorts."""
    n = points.shape[0]
    turn, row, first = np.empty(n, np.int64), np.empty(n, np.int64), np.zeros(_AZIMUTHS + 1, np.int64)
    for q in range(n):
        a, b, c = points[q, 0] - p[0], points[q, 1] - p[1], points[q, 2] - p[2]
        x = R[0, 0] * a + R[1, 0] * b + R[2, 0] * c
        y = R[0, 1] * a + R[1, 1] * b + R[2, 1] * c
        z = R[0, 2] * a + R[1, 2] * b + R[2, 2] * c
        seen[q, 0], seen[q, 1] = np.arctan2(y, x), np.arctan2(z, np.sqrt(x * x + y * y))
        seen[q, 2] = np.sqrt(x * x + y * y + z * z)
        turn[q] = min(int((seen[q, 0] + np.pi) / (2.0 * np.pi) * _AZIMUTHS), _AZIMUTHS - 1)
        row[q] = int((seen[q, 1] + 0.5 * np.pi) / line_rad)
        first[turn[q] + 1] += 1
        starts[row[q] + 1] += 1
    first, starts[:] = np.cumsum(first), np.cumsum(starts)
    around, at = np.empty(n, np.int64), starts[:-1].copy()
    for q in range(n):
        around[first[turn[q]]] = q
        first[turn[q]] += 1
    for k in range(n):
        q = around[k]
        order[at[row[q]]] = q
        at[row[q]] += 1


@njit(cache=True, nogil=True)
def _edges(points, seen, order, starts, limits, counts, out):  # type: ignore[no-untyped-def]
    """Line by line and sector by sector, the largest c first; returns how many."""
    n = order.shape[0]
    c, taken = np.zeros(n), np.zeros(n, np.bool_)
    found = 0
    for row in range(starts.shape[0] - 1):
        begin, end = starts[row], starts[row + 1]
        for k in range(begin, end):
            c[k] = _smoothness(points, seen, order, begin, end, k, limits, counts[0])
            if c[k] < limits[2] or not _goes_on(points, seen, order, starts, row, order[k], limits):
                c[k] = 0.0
        for sector in range(counts[1]):
            low = begin + (end - begin) * sector // counts[1]
            high = begin + (end - begin) * (sector + 1) // counts[1]
            for _ in range(counts[2]):
                best = -1
                for k in range(low, high):
                    if c[k] > 0.0 and not taken[k] and (best < 0 or c[k] > c[best]):
                        best = k
                if best < 0:
                    break
                _take(points, seen, order, begin, end, best, limits, counts[0], taken, out[found])
                found += 1
    return found


@njit(cache=True, nogil=True)
def _next(seen, order, begin, end, k, step, gap):  # type: ignore[no-untyped-def]
    """The neighbour of k in its line, around the circle; -1: a gap."""
    if end - begin < 2:
        return -1
    j = k + step
    if j >= end:
        j = begin
    elif j < begin:
        j = end - 1
    away = (seen[order[j], 0] - seen[order[k], 0]) * step
    if away < -1e-3:  # past the seam; azimuth steps may stand in any order
        away += 2.0 * np.pi
    return j if away <= gap else -1


@njit(cache=True, nogil=True)
def _smoothness(points, seen, order, begin, end, k, limits, neighbours):  # type: ignore[no-untyped-def]
    """LOAM's c; 1 where gaps are on both sides, 0 behind something nearer, or where the surface lies along the beam."""
    gap, jump = limits[0], limits[1]
    q = order[k]
    sx, sy, sz, used, gaps = 0.0, 0.0, 0.0, 0, 0
    for step in (-1, 1):
        at = k
        for _ in range(neighbours):
            j = _next(seen, order, begin, end, at, step, gap)
            if j < 0 or j == k:
                gaps += 1
                break
            other = order[j]
            fall = seen[order[at], 2] - seen[other, 2]
            if fall > jump and seen[other, 2] < seen[q, 2] - jump:
                return 0.0
            sx += points[other, 0] - points[q, 0]
            sy += points[other, 1] - points[q, 1]
            sz += points[other, 2] - points[q, 2]
            used += 1
            at = j
    if gaps == 2:
        return 1.0
    return np.sqrt(sx * sx + sy * sy + sz * sz) / (used * seen[q, 2])


@njit(cache=True, nogil=True)
def _goes_on(points, seen, order, starts, row, q, limits):  # type: ignore[no-untyped-def]
    """Whether a line above or below has a point from which q is no farther than 30 degrees to the beam allow."""
    gap, line_rad = limits[0], limits[3]
    for other in range(max(row - _ROWS_APART, 0), min(row + _ROWS_APART + 1, starts.shape[0] - 1)):
        if other == row:
            continue
        k = _first_after(seen, order, starts[other], starts[other + 1], seen[q, 0] - 0.5 * gap)
        while k < starts[other + 1] and seen[order[k], 0] <= seen[q, 0] + 0.5 * gap:
            j = order[k]
            k += 1
            apart = abs(seen[j, 1] - seen[q, 1])
            if apart < 0.5 * line_rad:
                continue
            x, y, z = points[j, 0] - points[q, 0], points[j, 1] - points[q, 1], points[j, 2] - points[q, 2]
            if x * x + y * y + z * z < (2.0 * apart * seen[q, 2]) ** 2:
                return True
    return False


@njit(cache=True, nogil=True)
def _first_after(seen, order, begin, end, azimuth):  # type: ignore[no-untyped-def]
    while begin < end:
        middle = (begin + end) // 2
        if seen[order[middle], 0] < azimuth:
            begin = middle + 1
        else:
            end = middle
    return begin


@njit(cache=True, nogil=True)
def _take(points, seen, order, begin, end, k, limits, neighbours, taken, edge):  # type: ignore[no-untyped-def]
    """The mean of the thing that k belongs to if it ends within the neighbours, else k; they are taken with it."""
    m0, m1, m2 = np.float64(points[order[k], 0]), np.float64(points[order[k], 1]), np.float64(points[order[k], 2])
    edge[0], edge[1], edge[2] = m0, m1, m2
    taken[k] = True
    used, ends = 1, 0
    for step in (-1, 1):
        at = k
        for _ in range(neighbours):
            j = _next(seen, order, begin, end, at, step, limits[0])
            if j < 0 or abs(seen[order[j], 2] - seen[order[at], 2]) > limits[1]:
                ends += 1
                break
            q = order[j]
            m0, m1, m2 = m0 + points[q, 0], m1 + points[q, 1], m2 + points[q, 2]
            taken[j] = True
            used += 1
            at = j
    if ends == 2:
        edge[0], edge[1], edge[2] = m0 / used, m1 / used, m2 / used
