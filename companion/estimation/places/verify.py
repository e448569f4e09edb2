"""Whether two clouds show the same place, and how they lie exactly: registration in space."""

from __future__ import annotations

from dataclasses import dataclass
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


@dataclass(frozen=True, slots=True, eq=False)
class Alignment:
    """x_known = R x_seen + p."""

    R: Array  # (3, 3)
    p: Array  # (3,), m
    near: float  # share of points with one of the other cloud near them
    weakest: float  # smallest eigenvalue of the scaled information


def align(known: Array32, seen: Array32, guess: tuple[Array, Array], config: VerifyConfig) -> Alignment | None:
    """The motion that lays cloud `seen` (M, 3) on cloud `known` (N, 3), m, from a guess (R, p); None: not sure."""
    target = PointMap(config.map)
    target.insert(known, np.eye(3), np.zeros(3))
    points = Thinner().centroids(seen, config.thin_m, at_most=config.points)
    registration = PlaneRegistration(target, points, config.plane)
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
    tree = cKDTree(known, compact_nodes=False, balanced_tree=False)  # asked once: quick to build counts
    gaps, _ = tree.query(points @ R.T + p, distance_upper_bound=config.near_m)
    near = float(np.isfinite(gaps).mean())
    return Alignment(R, p, near, normal.weakest) if near >= config.least_near else None
