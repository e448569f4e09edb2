"""Which landmark is what was seen? Nearest neighbour, and one-to-one inside statistical gates.

Source: Y. Bar-Shalom, P. Willett, X. Tian, "Tracking and Data Fusion", 2011, ch. 6 (gating, global
nearest neighbour). What two landmarks explain about equally well is told as ambiguous: a wrong
match spoils a landmark for good, a missed one costs nothing.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import chain
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from companion.core.errors import InputError
from companion.core.messages import Array, Bytes2D

VISUAL, TRUNK = 0, 1  # kinds of landmarks; only visual ones have a descriptor
KINDS = ("visual", "trunk")
DESCRIPTOR_BYTES = 32
_NEVER = 1e9  # cost of a pair outside the gates
NEW, AMBIGUOUS = -1, -2  # instead of the number of a landmark

Rows = NDArray[np.int64]
_Positive = Annotated[float, msgspec.Meta(gt=0.0)]


class AssociationConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """What may be the same thing."""

    method: Literal["gated", "nearest"] = "gated"
    """`gated`: optimal one-to-one assignment inside the gates; `nearest`: mutual nearest neighbours."""
    nearest_m: _Positive = 0.5  # `nearest` looks no farther
    chi2_gate: _Positive = 11.34  # squared Mahalanobis distance; 99 % of the true pairs, 3 degrees of freedom
    hamming_gate: Annotated[int, msgspec.Meta(ge=0, le=256)] = 70  # differing bits of 256
    hamming_weight: Annotated[float, msgspec.Meta(ge=0.0)] = 0.2  # chi2 that a differing bit is worth
    ambiguity: Annotated[float, msgspec.Meta(ge=0.0)] = 2.0  # chi2 by which the best must win


@dataclass(frozen=True, slots=True, eq=False)
class Observations:
    """What was seen at one time, one row each; `of` makes it from raw arrays."""

    position_odom: Array  # m, (M, 3)
    covariance: Array  # m2, (M, 3, 3)
    kind: NDArray[np.uint8]  # (M,), VISUAL or TRUNK
    descriptor: Bytes2D  # (M, 32), zeros for trunks
    radius_m: Array  # (M,), NaN: has none

    def __len__(self) -> int:
        return len(self.kind)

    @classmethod
    def of(
        cls,
        position_odom: Array,
        covariance: Array,
        kind: int,
        *,
        descriptor: Bytes2D | None = None,
        radius_m: Array | None = None,
    ) -> Observations:
        """Observations of one kind; rows that are not finite or have no covariance are left out.

        Raises InputError for shapes that do not fit.
        """
        position, spread = np.asarray(position_odom, np.float64), np.asarray(covariance, np.float64)
        count = len(position)
        bits = np.zeros((count, DESCRIPTOR_BYTES), np.uint8) if descriptor is None else np.asarray(descriptor, np.uint8)
        radius = np.full(count, np.nan) if radius_m is None else np.asarray(radius_m, np.float64)
        _check(kind, descriptor is not None)
        wanted = {"position_odom": (3,), "covariance": (3, 3), "descriptor": (DESCRIPTOR_BYTES,), "radius_m": ()}
        for name, shape in zip(wanted, (position.shape, spread.shape, bits.shape, radius.shape), strict=True):
            if shape != (count, *wanted[name]):
                raise InputError(f"shape {shape}", field=name, valid=str((count, *wanted[name])))
        good = are_covariances(spread) & (np.abs(position) < 1e6).all(axis=1)
        return cls(position[good], spread[good], np.full(int(good.sum()), kind, np.uint8), bits[good], radius[good])


def are_covariances(matrices: Array) -> NDArray[np.bool_]:
    """Which of (N, 3, 3) are finite, symmetric and safely positive definite."""
    finite = np.all(np.abs(matrices) < 1e12, axis=(1, 2))
    tame = np.where(finite[:, None, None], matrices, np.eye(3))
    scale = np.trace(tame, axis1=1, axis2=2)
    skewness = np.abs(tame - tame.transpose(0, 2, 1)).max(axis=(1, 2), initial=0.0)
    symmetric = skewness <= 1e-9 * np.abs(scale)
    lowest = np.linalg.eigvalsh(tame)[:, 0]
    return np.asarray(finite & symmetric & (lowest > 1e-12 * np.abs(scale)) & (lowest > 1e-15))


def associate(landmarks: NDArray[Any], seen: Observations, config: AssociationConfig) -> Rows:
    """Row (M,) in `landmarks` of each observation, NEW (-1) or AMBIGUOUS (-2); no row twice.

    `landmarks` (N,) is a struct array with position_odom, covariance, kind and descriptor
    (`companion.mapping.feature_map.LANDMARK`).
    """
    if config.method == "nearest":
        return _mutually_nearest(landmarks, seen, config.nearest_m)
    return _assign(_gated(landmarks, seen, config), len(seen), len(landmarks), config.ambiguity)


@dataclass(frozen=True, slots=True, eq=False)
class _Pairs:
    """Pairs of observation and landmark inside the gates, ordered by observation."""

    seen: Rows
    row: Rows
    cost: Array
    unmatched: Array  # cost of no landmark for the observation; at least any pair's


def _gated(landmarks: NDArray[Any], seen: Observations, config: AssociationConfig) -> _Pairs:
    """cost = d' S^-1 d + ln(|S| / |R|) + weight * differing bits, S = P + R."""
    i, j = _within_reach(landmarks, seen, config.chi2_gate)
    bits = np.bitwise_count(landmarks["descriptor"][j] ^ seen.descriptor[i]).sum(axis=1, dtype=np.int64)
    alike = (landmarks["kind"][j] == seen.kind[i]) & (bits <= config.hamming_gate)
    i, j, bits = i[alike], j[alike], bits[alike]
    S = landmarks["covariance"][j] + seen.covariance[i]
    d = seen.position_odom[i] - landmarks["position_odom"][j]
    chi2 = (d * np.linalg.solve(S, d[:, :, None])[:, :, 0]).sum(axis=1)
    widening = np.log(np.linalg.det(S) / np.linalg.det(seen.covariance)[i])
    inside = chi2 <= config.chi2_gate
    cost = chi2 + widening + config.hamming_weight * bits
    widest = np.zeros(len(seen))
    np.maximum.at(widest, i, widening)
    unmatched = config.chi2_gate + config.hamming_weight * config.hamming_gate + widest
    return _Pairs(i[inside], j[inside], cost[inside], unmatched)


def _within_reach(landmarks: NDArray[Any], seen: Observations, chi2_gate: float) -> tuple[Rows, Rows]:
    """Pairs near enough for the gate, by spheres around the ellipsoids."""
    if len(seen) == 0 or len(landmarks) == 0:
        return np.empty(0, np.int64), np.empty(0, np.int64)
    here, there = seen.position_odom, landmarks["position_odom"]
    widest = np.trace(landmarks["covariance"], axis1=1, axis2=2).max()
    reach = np.sqrt(chi2_gate * (np.trace(seen.covariance, axis1=1, axis2=2) + widest))
    low, high = here.min(axis=0) - reach.max(), here.max(axis=0) + reach.max()
    local = np.flatnonzero(((there >= low) & (there <= high)).all(axis=1))
    near = cKDTree(there[local]).query_ball_point(here, reach, return_sorted=True)
    counts = [len(rows) for rows in near]
    rows = np.fromiter(chain.from_iterable(near), np.int64, sum(counts))
    return np.repeat(np.arange(len(seen)), counts), local[rows]


def _assign(pairs: _Pairs, observations: int, landmarks: int, ambiguity: float) -> Rows:
    """Cluster by cluster of observations that share landmarks; most pairs are alone."""
    found = np.full(observations, NEW, np.int64)
    alone = (np.bincount(pairs.seen)[pairs.seen] == 1) & (np.bincount(pairs.row)[pairs.row] == 1)
    found[pairs.seen[alone]] = pairs.row[alone]
    crowded = np.flatnonzero(~alone)
    if len(crowded) == 0:
        return found
    ends = pairs.seen[crowded], observations + pairs.row[crowded]
    size = observations + landmarks
    graph = coo_array((np.ones(len(crowded)), ends), shape=(size, size))
    cluster = np.zeros(len(pairs.cost), np.int64)
    cluster[crowded] = connected_components(graph, directed=False)[1][ends[0]]
    order = crowded[np.argsort(cluster[crowded], kind="stable")]
    for part in np.split(order, np.flatnonzero(np.diff(cluster[order])) + 1):
        seen, a = np.unique(pairs.seen[part], return_inverse=True)
        rows, b = np.unique(pairs.row[part], return_inverse=True)
        cost = np.repeat(pairs.unmatched[seen, None], len(rows) + len(seen), axis=1)
        cost[:, : len(rows)] = _NEVER
        cost[a, b] = pairs.cost[part]
        found[seen] = _best(cost, rows, ambiguity)
    return found


def _best(cost: Array, rows: Rows, ambiguity: float) -> Rows:
    """Landmark of each observation of a cluster; the columns behind those of `rows` mean: none.

    An observation is ambiguous if it could swap with another one, or take a landmark that
    nobody has, for less than `ambiguity`.
    """
    column = linear_sum_assignment(cost)[1]
    matched = column < len(rows)
    mine = cost[np.arange(len(cost)), column]
    swapped = cost[:, column]
    worse = swapped + swapped.T - mine[:, None] - mine
    worse[~(matched[:, None] | matched)] = np.inf
    np.fill_diagonal(worse, np.inf)
    free = np.ones(len(rows), np.bool_)
    free[column[matched]] = False
    other = (cost[:, : len(rows)][:, free] - mine[:, None]).min(axis=1, initial=np.inf)
    other[~matched] = np.inf  # no landmark was worth it
    unclear = np.minimum(worse.min(axis=1, initial=np.inf), other) < ambiguity
    padded = np.concatenate([rows, np.full(len(cost), NEW)])
    return np.where(unclear, AMBIGUOUS, padded[column])


def _mutually_nearest(landmarks: NDArray[Any], seen: Observations, reach_m: float) -> Rows:
    """Pairs each of which is the other's nearest of its kind, by distance alone."""
    found = np.full(len(seen), NEW, np.int64)
    for kind in range(len(KINDS)):
        mine, rows = np.flatnonzero(seen.kind == kind), np.flatnonzero(landmarks["kind"] == kind)
        if len(mine) == 0 or len(rows) == 0:
            continue
        here, there = seen.position_odom[mine], landmarks["position_odom"][rows]
        far, nearest = cKDTree(there).query(here)
        back = cKDTree(here).query(there)[1]
        mutual = (back[nearest] == np.arange(len(mine))) & (far <= reach_m)
        found[mine[mutual]] = rows[nearest[mutual]]
    return found


def _check(kind: int, described: bool) -> None:
    if not 0 <= kind < len(KINDS):
        raise InputError(f"{kind} is no kind of landmark", field="kind", valid=", ".join(map(str, range(len(KINDS)))))
    if described != (kind == VISUAL):
        raise InputError("visual landmarks have one, others do not", field="descriptor")
