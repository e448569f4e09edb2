"""Trunks as stars: a place is known by the triangles that its trunks make.

Each trunk and two of its neighbours make a triangle; its three sides do not change with the
place or heading of the vehicle. Triangles of a view that resemble triangles of a map each give a
hypothesis, where the view would lie in the map; the one under which most trunks of the view meet
a trunk of the map wins. The idea is that of star trackers, and of geometric hashing (Y. Lamdan
and H. Wolfson, ICCV 1988).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import combinations
from typing import Annotated

import msgspec
import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from companion.core.messages import Array

Metres = Annotated[float, msgspec.Meta(gt=0)]
Count = Annotated[int, msgspec.Meta(ge=1)]
_REFINEMENTS = 3
_RIVAL = 0.5  # share of the most trunks from which on a place may still win by refinement


class ConstellationConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Which triangles are made, and what counts as the same place."""

    neighbours: Annotated[int, msgspec.Meta(ge=2, le=20)] = 8  # of each trunk, that make triangles with it
    shortest_m: Metres = 2.0  # a side of a triangle at least
    longest_m: Metres = 14.0  # at most
    unlike_m: Metres = 0.25  # sides of one triangle differ at least by this: their order must be sure
    side_tolerance_m: Metres = 0.25  # distance of two triangles, over their three sides
    alike: Count = 12  # triangles of the map that one of the view is compared with
    corner_tolerance_m: Metres = 0.3  # largest gap when one triangle is laid on the other
    inlier_m: Metres = 0.35  # gap of a trunk of the view to one of the map
    least_inliers: Count = 8  # trunks that must agree before a place is believed ...
    least_share: Annotated[float, msgspec.Meta(gt=0, le=1)] = 0.5  # ... and share of those seen
    least_lead: Annotated[float, msgspec.Meta(gt=0, le=1)] = 0.75
    """The second best place, elsewhere, may have at most this share of the best one's trunks."""
    elsewhere_m: Metres = 1.0
    most_places: Count = 20  # that `match` returns


@dataclass(frozen=True, slots=True, eq=False)
class Constellation:
    """Trunks from above, and the triangles that they make."""

    centers: Array  # (N, 2), m
    sides: Array  # (K, 3), m, ascending
    corners: NDArray[np.int64]  # (K, 3), trunks, each opposite to its side
    trunk_tree: cKDTree | None  # of `centers`
    side_tree: cKDTree | None  # of `sides`


@dataclass(frozen=True, slots=True, eq=False)
class Place:
    """Where a view lies in a map: point_map = R(yaw) point_view + p_map."""

    p_map: Array  # (2,), m
    yaw: float
    inliers: int  # trunks of the view that meet one of the map
    share: float  # of the trunks of the view
    rms_m: float  # of their gaps

    def to_map(self, points_view: Array) -> Array:
        """Points (N, 2) of the view, in the map."""
        c, s = math.cos(self.yaw), math.sin(self.yaw)
        placed: Array = points_view @ np.array([[c, s], [-s, c]]) + self.p_map
        return placed


def constellation(centers: Array, config: ConstellationConfig) -> Constellation:
    """The triangles of trunks at `centers` (N, 2), m, in a levelled frame."""
    points = np.ascontiguousarray(centers, np.float64).reshape(-1, 2)
    if len(points) < 3:
        return Constellation(points, np.empty((0, 3)), np.empty((0, 3), np.int64), None, None)
    tree = cKDTree(points)
    corners = _corners(points, tree, config.neighbours)
    a, b, c = (points[corners[:, k]] for k in range(3))
    sides = np.stack([np.linalg.norm(b - c, axis=1), np.linalg.norm(a - c, axis=1), np.linalg.norm(a - b, axis=1)], 1)
    order = np.argsort(sides, axis=1)
    sides, corners = np.take_along_axis(sides, order, 1), np.take_along_axis(corners, order, 1)
    good = (sides[:, 0] >= config.shortest_m) & (sides[:, 2] <= config.longest_m)
    good &= np.diff(sides, axis=1).min(axis=1) >= config.unlike_m
    sides, corners = sides[good], corners[good]
    return Constellation(points, sides, corners, tree, cKDTree(sides) if len(sides) else None)


def match(known: Constellation, view: Constellation, config: ConstellationConfig) -> list[Place]:
    """Places of `view` in `known` that differ, best first; empty: no triangle is alike."""
    if known.side_tree is None or known.trunk_tree is None or not len(view.sides):
        return []
    yaw, shift = _hypotheses(known, view, config)
    if not len(yaw):
        return []
    counts = _inliers(known, view, (yaw, shift), config)
    places: list[Place] = []
    for n in np.argsort(-counts, kind="stable")[: 10 * config.most_places]:
        if any(np.linalg.norm(p.p_map - shift[n]) < config.elsewhere_m for p in places):
            continue
        place = Place(shift[n], float(yaw[n]), int(counts[n]), counts[n] / len(view.centers), math.inf)
        rival = counts[n] >= _RIVAL * counts.max()  # the others only need to be there
        places.append(_refined(known, view, place, config) if rival else place)
        if len(places) == config.most_places:
            break
    return sorted(places, key=lambda p: (-p.inliers, p.rms_m))


def accepted(places: list[Place], config: ConstellationConfig) -> Place | None:
    """The best place if it is sure, None if the vehicle cannot know where it is."""
    if not places:
        return None
    best = places[0]
    sure = best.inliers >= config.least_inliers and best.share >= config.least_share
    others = [p.inliers for p in places[1:] if np.linalg.norm(p.p_map - best.p_map) >= config.elsewhere_m]
    return best if sure and max(others, default=0) <= config.least_lead * best.inliers else None


def ambiguous(places: list[Place], config: ConstellationConfig) -> bool:
    """Whether trunks enough agree, but elsewhere, too: rows of posts, a plantation."""
    if not places:
        return False
    best = places[0]
    return best.inliers >= config.least_inliers and best.share >= config.least_share and not accepted(places, config)


def _corners(points: Array, tree: cKDTree, neighbours: int) -> NDArray[np.int64]:
    """Trunks (K, 3) of each triangle, every one once."""
    _, near = tree.query(points, k=min(neighbours + 1, len(points)))
    pairs = np.array(list(combinations(range(1, near.shape[1]), 2)))
    triangles = np.stack(
        [np.repeat(near[:, :1], len(pairs), axis=1), near[:, pairs[:, 0]], near[:, pairs[:, 1]]], axis=2
    )
    return np.unique(np.sort(triangles.reshape(-1, 3), axis=1), axis=0).astype(np.int64)


def _hypotheses(known: Constellation, view: Constellation, config: ConstellationConfig) -> tuple[Array, Array]:
    """(yaw (H,), shift (H, 2)) that lay a triangle of the view on one of the map."""
    assert known.side_tree is not None
    # two more than there are, so that the answer is two-dimensional even for a single neighbour
    _, alike = known.side_tree.query(view.sides, k=config.alike + 1, distance_upper_bound=config.side_tolerance_m)
    of_view, slot = np.nonzero(alike < len(known.sides))
    of_map = alike[of_view, slot]
    a, b = known.centers[known.corners[of_map]], view.centers[view.corners[of_view]]
    yaw, shift = _laid(a, b)
    placed = _turned(b, yaw) + shift[:, None]
    good = np.abs(placed - a).max(axis=(1, 2)) <= config.corner_tolerance_m if len(a) else np.empty(0, bool)
    return yaw[good], shift[good]


def _laid(a: Array, b: Array) -> tuple[Array, Array]:
    """Rigid motions (yaw (H,), shift (H, 2)) of least squares from points b (H, M, 2) to a."""
    middle_a, middle_b = a.mean(axis=1), b.mean(axis=1)
    da, db = a - middle_a[:, None], b - middle_b[:, None]
    cross = np.sum(db[..., 0] * da[..., 1] - db[..., 1] * da[..., 0], axis=1)
    yaw = np.arctan2(cross, np.sum(da * db, axis=(1, 2)))
    return yaw, middle_a - _turned(middle_b[:, None], yaw)[:, 0]


def _turned(points: Array, yaw: Array) -> Array:
    """Points (H, M, 2), each set turned by its yaw."""
    c, s = np.cos(yaw)[:, None], np.sin(yaw)[:, None]
    x, y = points[..., 0], points[..., 1]
    return np.stack([c * x - s * y, s * x + c * y], axis=-1)


def _inliers(
    known: Constellation, view: Constellation, motions: tuple[Array, Array], config: ConstellationConfig
) -> NDArray[np.int64]:
    """Trunks of the map (H,) that meet one of the view."""
    yaw, shift = motions
    counts = np.zeros(len(yaw), np.int64)
    cells, corner = _cells(known.centers, config.inlier_m)
    tables = (cells, corner, np.ascontiguousarray(known.centers), np.ascontiguousarray(view.centers))
    _count_inliers(tables, yaw, shift, config.inlier_m, counts)
    return counts


def _cells(centers: Array, cell_m: float) -> tuple[NDArray[np.int64], Array]:
    """Trunks by cell: (nx, ny, 3), up to three of each, -1: none; and the low corner (2,) of a rim of one cell."""
    corner = centers.min(axis=0) - cell_m
    at = np.floor((centers - corner) / cell_m).astype(np.int64)
    cells = np.full((*(at.max(axis=0) + 2), 3), -1, np.int64)
    for n, (i, j) in enumerate(at.tolist()):
        free = np.flatnonzero(cells[i, j] < 0)
        if len(free):
            cells[i, j, free[0]] = n
    return cells, corner


@njit(cache=True, nogil=True)
def _count_inliers(tables, yaw, shift, inlier_m, counts):  # type: ignore[no-untyped-def]
    """Trunks of the map that are the nearest of some trunk of the view, each counted once."""
    cells, corner, known, view = tables
    last = np.full(known.shape[0], -1, np.int64)
    for h in range(yaw.shape[0]):
        c, s = math.cos(yaw[h]), math.sin(yaw[h])
        for n in range(view.shape[0]):
            x = c * view[n, 0] - s * view[n, 1] + shift[h, 0]
            y = s * view[n, 0] + c * view[n, 1] + shift[h, 1]
            met = _nearest(cells, corner, known, x, y, inlier_m)
            if met >= 0 and last[met] != h:
                last[met] = h
                counts[h] += 1


@njit(cache=True, nogil=True)
def _nearest(cells, corner, known, x, y, inlier_m):  # type: ignore[no-untyped-def]
    """The nearest trunk within `inlier_m`, -1: none."""
    i, j = math.floor((x - corner[0]) / inlier_m), math.floor((y - corner[1]) / inlier_m)
    best, met = inlier_m * inlier_m, -1
    for a in range(max(i - 1, 0), min(i + 2, cells.shape[0])):
        for b in range(max(j - 1, 0), min(j + 2, cells.shape[1])):
            for k in range(3):
                n = cells[a, b, k]
                if n < 0:
                    break
                gap = (known[n, 0] - x) ** 2 + (known[n, 1] - y) ** 2
                if gap < best:
                    best, met = gap, n
    return met


def _refined(known: Constellation, view: Constellation, place: Place, config: ConstellationConfig) -> Place:
    """Least squares over all trunks that meet, repeated as more of them do."""
    assert known.trunk_tree is not None
    gaps = np.full(len(view.centers), np.inf)
    for _ in range(_REFINEMENTS):
        gaps, met = known.trunk_tree.query(place.to_map(view.centers), distance_upper_bound=config.inlier_m)
        good = np.isfinite(gaps)
        if good.sum() < 3:
            break
        yaw, shift = _laid(known.centers[met[good]][None], view.centers[good][None])
        place = Place(shift[0], float(yaw[0]), place.inliers, 0.0, 0.0)
    gaps, met = known.trunk_tree.query(place.to_map(view.centers), distance_upper_bound=config.inlier_m)
    good = np.isfinite(gaps)
    inliers = len(np.unique(met[good]))
    rms_m = float(np.sqrt(np.mean(gaps[good] ** 2))) if inliers else math.inf
    return Place(place.p_map, place.yaw, inliers, inliers / len(view.centers), rms_m)
