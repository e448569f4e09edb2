"""Whether two clouds show the same place, and how they lie exactly: registration in space."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated

import msgspec
import numpy as np
from scipy.spatial import cKDTree

from companion.core.geometry import exp_so3
from companion.core.messages import Array, Array32
from companion.estimation.downsample import Thinner
from companion.estimation.point_map import PointMap, PointMapConfig
from companion.estimation.registration import PlaneConfig, PlaneRegistration
from companion.estimation.so3 import orthonormal

Positive = Annotated[float, msgspec.Meta(gt=0)]
Count = Annotated[int, msgspec.Meta(ge=1)]


class VerifyConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Registration of one submap against another, and what must hold at its end."""

    map: PointMapConfig = PointMapConfig(max_voxels=60_000)
    plane: PlaneConfig = PlaneConfig()
    thin_m: Positive = 0.4  # of the cloud that is registered
    points: Count = 3000
    iterations: Count = 12
    settled_m: Positive = 1e-3  # last step at most
    near_m: Positive = 0.2  # a point of one cloud has one of the other this near ...
    least_near: Annotated[float, msgspec.Meta(gt=0, le=1)] = 0.6  # ... for at least this share
    least_eigenvalue: Positive = 0.01  # of the scaled information: no direction may be blind
    slides: Annotated[int, msgspec.Meta(ge=0)] = 0  # along the direction that is nearest to blind, each registered anew
    slide_m: Positive = 0.6  # to both sides at most


_SLIDE_STEP_M = 0.1


class Known:
    """A cloud (N, 3), m, that others are laid on: as planes, and as points."""

    def __init__(self, points: Array32, config: VerifyConfig) -> None:
        self.target = PointMap(config.map)
        self.target.insert(points, np.eye(3), np.zeros(3))
        self._tree = cKDTree(points, compact_nodes=False, balanced_tree=False)  # asked seldom: quick to build counts
        self._far_m = 1.5 * config.near_m

    def gaps_m(self, points: Array) -> Array:
        """From points (M, 3) to the nearest one, (M,); at most half as far again as `near_m`."""
        gaps, _ = self._tree.query(points, distance_upper_bound=self._far_m)
        return np.minimum(np.asarray(gaps, np.float64), self._far_m)


@dataclass(frozen=True, slots=True, eq=False)
class Alignment:
    """x_known = R x_seen + p."""

    R: Array  # (3, 3)
    p: Array  # (3,), m
    near: float  # share of points with one of the other cloud near them
    weakest: float  # smallest eigenvalue of the scaled information
    gap_m: float  # mean distance to the nearest point of the other cloud
    blindest: Array  # unit, (3,): the translation that it holds least


def align(known: Array32 | Known, seen: Array32, guess: tuple[Array, Array], config: VerifyConfig) -> Alignment | None:
    """The motion that lays cloud `seen` (M, 3) on cloud `known` (N, 3), m, from a guess (R, p); None: not sure."""
    whole = known if isinstance(known, Known) else Known(known, config)
    points = Thinner().centroids(seen, config.thin_m, at_most=config.points)
    found = _registered(whole, points, guess, config)
    for _ in range(config.slides if found is not None else 0):
        assert found is not None
        slid = _slid(whole, points, found, config)
        again = _registered(whole, points, (slid.R, slid.p), config)
        best = slid if again is None or slid.gap_m <= again.gap_m else again
        if best.gap_m >= found.gap_m:
            break
        found = best
    return found if found is not None and found.near >= config.least_near else None


def _registered(known: Known, points: Array, guess: tuple[Array, Array], config: VerifyConfig) -> Alignment | None:
    registration = PlaneRegistration(known.target, points, config.plane)
    R, p = np.ascontiguousarray(guess[0]), guess[1]  # one layout: a kernel is compiled for each
    step = np.full(6, np.inf)
    for _ in range(config.iterations):
        normal = registration.linearise(R, p)
        if normal.weakest < config.least_eigenvalue:
            return None
        step = np.asarray(np.linalg.solve(normal.H, normal.g), np.float64)
        R, p = orthonormal(R @ exp_so3(step[:3])), p + step[3:]
        if np.linalg.norm(step[3:]) < config.settled_m:
            break
    if np.linalg.norm(step[3:]) >= config.settled_m:
        return None
    blindest = np.asarray(np.linalg.eigh(normal.H[3:, 3:])[1][:, 0])
    return _judged(known, points, Alignment(R, p, 0.0, normal.weakest, 0.0, blindest), config)


def _judged(known: Known, points: Array, found: Alignment, config: VerifyConfig) -> Alignment:
    gaps = known.gaps_m(points @ found.R.T + found.p)
    return replace(found, near=float((gaps < config.near_m).mean()), gap_m=float(gaps.mean()))


def _slid(known: Known, points: Array, found: Alignment, config: VerifyConfig) -> Alignment:
    """Along its blindest direction to where the clouds are nearest.

    Planes hold such a direction by few points, and steps along it get short long before it is met.
    """
    most = round(config.slide_m / _SLIDE_STEP_M)
    shifts = np.arange(-most, most + 1) * _SLIDE_STEP_M
    placed = points @ found.R.T + found.p
    gaps = np.array([known.gaps_m(placed + shift * found.blindest).mean() for shift in shifts])
    k = int(np.argmin(gaps))
    shift = shifts[k]
    if 0 < k < len(shifts) - 1:
        bend = gaps[k - 1] - 2.0 * gaps[k] + gaps[k + 1]
        shift += 0.5 * _SLIDE_STEP_M * (gaps[k - 1] - gaps[k + 1]) / max(bend, 1e-12)
    return _judged(known, points, replace(found, p=found.p + shift * found.blindest), config)
