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
_LINES_APART = 2  # an edge goes on within so many lines: thin poles are not hit in each


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
    starts = np.zeros(math.ceil(math.pi / line_rad) + 2, np.int64)  # of each line
    lined = np.empty((len(points_body), 6))  # x, y, z in the body; azimuth, elevation and range from the sensor
    _lines(points_body, mount.R_body_sensor, mount.p_body, line_rad, lined, starts)
    out = np.empty((len(points_body), 3))
    limits = (math.radians(config.gap_deg), config.jump_m, config.smoothness, line_rad)
    counts = (config.neighbours, config.sectors, config.per_sector)
    return out[: _edges(lined, starts, limits, counts, out)]


@njit(cache=True, nogil=True)
def _lines(points, R, p, line_rad, lined, starts):  # type: ignore[no-untyped-def]
    """The points by line, then azimuth, by two counting sorts."""
    n = points.shape[0]
    seen, turn, row = np.empty((n, 3)), np.empty(n, np.int64), np.empty(n, np.int64)
    first = np.zeros(_AZIMUTHS + 1, np.int64)
    for q in range(n):
        a, b, c = points[q, 0] - p[0], points[q, 1] - p[1], points[q, 2] - p[2]
        x = R[0, 0] * a + R[1, 0] * b + R[2, 0] * c
        y = R[0, 1] * a + R[1, 1] * b + R[2, 1] * c
        z = R[0, 2] * a + R[1, 2] * b + R[2, 2] * c
        level = np.sqrt(x * x + y * y)
        seen[q, 0], seen[q, 1], seen[q, 2] = np.arctan2(y, x), np.arctan2(z, level), np.sqrt(x * x + y * y + z * z)
        turn[q] = min(int((seen[q, 0] + np.pi) / (2.0 * np.pi) * _AZIMUTHS), _AZIMUTHS - 1)
        row[q] = int((seen[q, 1] + 0.5 * np.pi) / line_rad)
        first[turn[q] + 1] += 1
        starts[row[q] + 1] += 1
    first, starts[:] = np.cumsum(first), np.cumsum(starts)
    around, at = np.empty(n, np.int64), starts[:-1].copy()
    for q in range(n):
        around[first[turn[q]]] = q
        first[turn[q]] += 1
    for u in range(n):
        q = around[u]
        k = at[row[q]]
        at[row[q]] += 1
        for i in range(3):
            lined[k, i], lined[k, 3 + i] = points[q, i], seen[q, i]


@njit(cache=True, nogil=True)
def _edges(lined, starts, limits, counts, out):  # type: ignore[no-untyped-def]
    """Line by line and sector by sector, the largest c first; returns how many."""
    c = np.zeros(lined.shape[0])
    found = 0
    for row in range(starts.shape[0] - 1):
        begin, end = starts[row], starts[row + 1]
        for k in range(begin, end):
            c[k] = _smoothness(lined, begin, end, k, limits, counts[0])
            if c[k] < limits[2] or not _goes_on(lined, starts, row, k, limits):
                c[k] = 0.0
        for sector in range(counts[1]):
            low = begin + (end - begin) * sector // counts[1]
            high = begin + (end - begin) * (sector + 1) // counts[1]
            for _ in range(counts[2]):
                best = low
                for k in range(low, high):
                    if c[k] > c[best]:
                        best = k
                if low == high or c[best] == 0.0:
                    break
                _take(lined, begin, end, best, limits, counts[0], c, out[found])
                found += 1
    return found


@njit(cache=True, nogil=True)
def _next(lined, begin, end, k, step, gap):  # type: ignore[no-untyped-def]
    """The neighbour of k in its line, around the circle; -1: a gap."""
    j = k + step
    if j >= end:
        j = begin
    elif j < begin:
        j = end - 1
    away = (lined[j, 3] - lined[k, 3]) * step
    if away < -1e-3:  # past the seam; azimuths within a step of the sort stand in any order
        away += 2.0 * np.pi
    return j if away <= gap and j != k else -1


@njit(cache=True, nogil=True)
def _smoothness(lined, begin, end, k, limits, neighbours):  # type: ignore[no-untyped-def]
    """LOAM's c; 1 where gaps are on both sides, 0 behind something nearer, or where the surface lies along the beam."""
    gap, jump, range_m = limits[0], limits[1], lined[k, 5]
    sx, sy, sz, used, gaps = 0.0, 0.0, 0.0, 0, 0
    for step in (-1, 1):
        at = k
        for _ in range(neighbours):
            j = _next(lined, begin, end, at, step, gap)
            if j < 0:
                gaps += 1
                break
            if lined[at, 5] - lined[j, 5] > jump and lined[j, 5] < range_m - jump:
                return 0.0
            sx, sy, sz = sx + lined[j, 0] - lined[k, 0], sy + lined[j, 1] - lined[k, 1], sz + lined[j, 2] - lined[k, 2]
            used += 1
            at = j
    if gaps == 2:
        return 1.0
    return np.sqrt(sx * sx + sy * sy + sz * sz) / (used * range_m)


@njit(cache=True, nogil=True)
def _goes_on(lined, starts, row, k, limits):  # type: ignore[no-untyped-def]
    """Whether a line above or below has a point to which the way from k leaves the beam by 30 degrees or more."""
    gap, line_rad, azimuth = limits[0], limits[3], lined[k, 3]
    for other in range(max(row - _LINES_APART, 0), min(row + _LINES_APART + 1, starts.shape[0] - 1)):
        if other == row:
            continue
        j = _first_after(lined, starts[other], starts[other + 1], azimuth - 0.5 * gap)
        while j < starts[other + 1] and lined[j, 3] <= azimuth + 0.5 * gap:
            apart = abs(lined[j, 4] - lined[k, 4])
            x, y, z = lined[j, 0] - lined[k, 0], lined[j, 1] - lined[k, 1], lined[j, 2] - lined[k, 2]
            if apart > 0.5 * line_rad and x * x + y * y + z * z < (2.0 * apart * lined[k, 5]) ** 2:
                return True
            j += 1
    return False


@njit(cache=True, nogil=True)
def _first_after(lined, begin, end, azimuth):  # type: ignore[no-untyped-def]
    while begin < end:
        middle = (begin + end) // 2
        if lined[middle, 3] < azimuth:
            begin = middle + 1
        else:
            end = middle
    return begin


@njit(cache=True, nogil=True)
def _take(lined, begin, end, k, limits, neighbours, c, edge):  # type: ignore[no-untyped-def]
    """The mean of the thing that k belongs to if it ends within the neighbours, else k; none of them is taken again."""
    m0, m1, m2 = lined[k, 0], lined[k, 1], lined[k, 2]
    edge[0], edge[1], edge[2] = m0, m1, m2
    c[k] = 0.0
    used, ends = 1, 0
    for step in (-1, 1):
        at = k
        for _ in range(neighbours):
            j = _next(lined, begin, end, at, step, limits[0])
            if j < 0 or abs(lined[j, 5] - lined[at, 5]) > limits[1]:
                ends += 1
                break
            m0, m1, m2 = m0 + lined[j, 0], m1 + lined[j, 1], m2 + lined[j, 2]
            c[j] = 0.0
            used += 1
            at = j
    if ends == 2:
        edge[0], edge[1], edge[2] = m0 / used, m1 / used, m2 / used
