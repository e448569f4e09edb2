"""A piece of the way as one cloud, and whether two of them show the same place.

Where trunks stand they are compared as constellations; elsewhere the panorama of the newer one
is looked for among those that the older one has at points about where odometry expects it. Either
guess counts only if registration in space confirms it, and a guess from panoramas only if it fits
better than others elsewhere: aisles look alike.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated

import msgspec
import numpy as np

from companion.core.messages import Array, Array32
from companion.estimation.places.constellation import (
    Constellation,
    ConstellationConfig,
    Place,
    accepted,
    ambiguous,
    constellation,
    match,
)
from companion.estimation.places.correlate import CorrelateConfig, HitMap
from companion.estimation.places.trunks import TrunkConfig, detect_trunks
from companion.estimation.places.verify import Alignment, Known, VerifyConfig, align
from companion.estimation.places.views import Sight, ViewConfig, eyes_about, panorama, panoramas, sights

Positive = Annotated[float, msgspec.Meta(gt=0)]
Count = Annotated[int, msgspec.Meta(ge=1)]
_ELSEWHERE_M = 0.5  # fits farther apart are two places


class CompareConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """How two places are compared."""

    trunks: TrunkConfig = TrunkConfig()
    constellation: ConstellationConfig = ConstellationConfig()
    verify: VerifyConfig = VerifyConfig()
    ground_cell_m: Positive = 1.0  # whose lowest points say how much higher one lies: trunks do not, odometry may drift
    reach_m: Positive = 13.0  # of the one that saw more, that points of the other must lie in to count: both saw it
    view: ViewConfig = ViewConfig()
    correlate: CorrelateConfig = CorrelateConfig()
    view_verify: VerifyConfig = VerifyConfig(near_m=0.2, least_near=0.85, settled_m=5e-3, iterations=20)
    eye_step_m: Positive = 1.0  # of the grid on which panoramas are compared
    view_reach_m: Positive = 10.0  # of the newer one: farther out the older one saw less
    most_fits: Count = 4  # guesses that are registered, of those that most points hit
    view_turn_rad: Positive = 0.35  # most that heading by odometry may be wrong when panoramas are compared
    view_lead: Annotated[float, msgspec.Meta(gt=0, le=1)] = 0.9
    """The second best fit, elsewhere, may have at most this share of the points that fit of the best one ..."""
    view_misfits: Annotated[float, msgspec.Meta(ge=1)] = 1.0
    """... and has at least so many times its points that do not: where all is seen again, few are left over."""


@dataclass(frozen=True, eq=False)
class Submap:
    """What was seen about a keyframe, in axes of odom with the origin at the keyframe."""

    keyframe: int
    cloud: Array32  # (N, 3), m
    config: CompareConfig

    @cached_property
    def sky(self) -> Constellation:
        """Its trunks; found when somebody asks, since most submaps are never compared."""
        trunks = detect_trunks(self.cloud.astype(np.float64), self.config.trunks)
        return constellation(trunks.centers, self.config.constellation)

    @cached_property
    def wooded(self) -> bool:
        """Whether there are trunks enough to know it by."""
        return len(self.sky.centers) >= self.config.constellation.least_inliers

    @cached_property
    def hits(self) -> HitMap:
        """Its cells."""
        return HitMap(self.cloud, self.config.correlate)

    @cached_property
    def panorama(self) -> Array32:
        """Of the keyframe."""
        return panorama(self.cloud, self.config.view)


@dataclass(frozen=True, slots=True, eq=False)
class Match:
    """One submap in another: x_old = R x_new + p."""

    R: Array  # (3, 3)
    p: Array  # (3,), m
    trunks: int  # that agreed; 0: known by its panorama
    near: float  # share of points that fit


def compare(old: Submap, new: Submap, expected: Array, gate_m: float) -> Match | None:
    """`new` in `old`, within `gate_m` of where odometry `expected` it (3,); None: not the same place, or not sure."""
    if not (old.wooded and new.wooded):
        return _by_view(old, new, expected, gate_m)
    places = match(old.sky, new.sky, old.config.constellation)
    place = accepted(places, old.config.constellation)
    if place is not None:
        return _by_trunks(old, new, place, (expected, gate_m))
    return _by_view(old, new, expected, gate_m) if ambiguous(places, old.config.constellation) else None


def _by_trunks(old: Submap, new: Submap, place: Place, expected: tuple[Array, float]) -> Match | None:
    if np.linalg.norm(place.p_map - expected[0][:2]) > expected[1]:
        return None
    R, p = turn_z(place.yaw), np.array([*place.p_map, expected[0][2]])
    p[2] += rise(old.cloud, _moved(new.cloud, R, p), cell_m=old.config.ground_cell_m)
    if len(new.cloud) <= len(old.cloud):
        aligned = _laid_on(old, new, (R, p))
        return None if aligned is None else Match(aligned.R, aligned.p, place.inliers, aligned.near)
    aligned = _laid_on(new, old, (R.T, -R.T @ p))
    return None if aligned is None else Match(aligned.R.T, -aligned.R.T @ aligned.p, place.inliers, aligned.near)


def _laid_on(more: Submap, less: Submap, guess: tuple[Array, Array]) -> Alignment | None:
    """The one that saw less on the one that saw more, or half of it would meet nothing."""
    placed = _moved(less.cloud, *guess)
    both = less.cloud[np.einsum("ij,ij->i", placed, placed) < more.config.reach_m**2]
    return align(more.cloud, both, guess, more.config.verify)


def _moved(cloud: Array32, R: Array, p: Array) -> Array32:
    return np.asarray(cloud @ R.T.astype(np.float32) + p.astype(np.float32))


def _by_view(old: Submap, new: Submap, expected: Array, gate_m: float) -> Match | None:
    config = old.config
    eyes = eyes_about(expected, min(gate_m, config.view.farthest_m), config.eye_step_m)
    places = sights(panoramas(old.cloud, eyes, config.view), eyes, new.panorama, config.view)
    places = [s for s in places if abs(s.yaw) <= config.view_turn_rad]
    near = new.cloud[np.einsum("ij,ij->i", new.cloud, new.cloud) < config.view_reach_m**2]
    aligned = best_fit(lambda _: old.cloud, old.hits, near, places, config)
    return None if aligned is None else Match(aligned.R, aligned.p, 0, aligned.near)


def best_fit(
    known: Callable[[Array], Array32 | Known],
    hits: HitMap,
    seen: Array32,
    places: list[Sight],
    config: CompareConfig,
) -> Alignment | None:
    """Register cloud `seen` at the likeliest places; the fit that leads all others elsewhere, or None.

    `known` gives what is known about a place (3,).
    """
    points = hits.thinned(seen)
    guesses = sorted((hits.refined(points, s.p_map, s.yaw) for s in places), key=lambda guess: -guess[2])
    loose = msgspec.structs.replace(config.view_verify, least_near=0.3)
    fits = [align(known(p), seen, (turn_z(yaw), p), loose) for p, yaw in _apart(guesses)[: config.most_fits]]
    ranked = sorted((f for f in fits if f is not None), key=lambda f: -f.near)
    if not ranked or ranked[0].near < config.view_verify.least_near:
        return None
    best = ranked[0]
    rival = max((f.near for f in ranked[1:] if np.linalg.norm(f.p - best.p) > _ELSEWHERE_M), default=0.0)
    leads = rival <= config.view_lead * best.near and 1.0 - rival >= config.view_misfits * (1.0 - best.near)
    return best if leads else None


def _apart(guesses: list[tuple[Array, float, float]]) -> list[tuple[Array, float]]:
    """Places (p, yaw) of guesses, best first; of those that lie together the best one."""
    kept: list[tuple[Array, float]] = []
    for p, yaw, _ in guesses:
        if all(np.linalg.norm(p - other) > _ELSEWHERE_M for other, _ in kept):
            kept.append((p, yaw))
    return kept


def rise(known: Array32, placed: Array32, *, cell_m: float) -> float:
    """How far `placed` (M, 3) must rise for its ground to be that of `known` (N, 3), m: median over cells of both."""
    low, other = _lowest(known, cell_m), _lowest(placed, cell_m)
    gaps = [low[cell] - z for cell, z in other.items() if cell in low]
    return float(np.median(gaps)) if gaps else 0.0


def _lowest(points: Array32, cell_m: float) -> dict[int, float]:
    """Lowest z by cell of the plane."""
    at = np.floor(points[:, :2] / cell_m).astype(np.int64) + (1 << 20)
    cells, inverse = np.unique(at[:, 0] << 32 | at[:, 1], return_inverse=True)
    low = np.full(len(cells), np.inf)
    np.minimum.at(low, inverse, points[:, 2].astype(np.float64))
    return dict(zip(cells.tolist(), low.tolist(), strict=True))


def turn_z(yaw: float) -> Array:
    """Rotation (3, 3) about z."""
    c, s = math.cos(yaw), math.sin(yaw)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
