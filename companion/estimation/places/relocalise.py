"""Lost: finds the vehicle in a map of trunks, or says that it cannot know yet.

Views are matched as constellations. What is sure is answered at once. What is not, because the
forest repeats itself or few trunks are in sight, is kept as particles about every place that fits, and
moved and weighed with each further view until one place holds them and its trunks agree.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import msgspec
import numpy as np

from companion.core.messages import Array
from companion.estimation.places.constellation import (
    Constellation,
    ConstellationConfig,
    Place,
    accepted,
    constellation,
    match,
)
from companion.estimation.places.particles import LikelihoodField, ParticleConfig, Particles

Positive = Annotated[float, msgspec.Meta(gt=0)]
Count = Annotated[int, msgspec.Meta(ge=1)]


class RelocaliseConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """When an answer is sure."""

    constellation: ConstellationConfig = ConstellationConfig()
    particles: ParticleConfig = ParticleConfig()
    per_place: Count = 150  # particles about each place that fits
    spread_m: Positive = 0.3
    spread_rad: Positive = 0.03
    kept: Count = 3000  # particles
    together_m: Positive = 1.0  # particles this near are one place
    sure_share: Annotated[float, msgspec.Meta(gt=0.5, lt=1)] = 0.99  # of the weight in one place
    least_views: Count = 3  # that particles must have seen
    fit_m: Positive = 0.35  # a trunk of a view has one of the map this near ...
    least_fit: Annotated[float, msgspec.Meta(gt=0, le=1)] = 0.6  # ... for at least this share, over these views
    least_trunks: Count = 5  # in a view that may be judged


@dataclass(frozen=True, slots=True, eq=False)
class Answer:
    """Where the body is in the map: point_map = R(yaw) point_body + p_map, levelled."""

    p_map: Array  # (2,), m
    yaw: float
    views: int  # that it took
    by: str  # "constellation" or "particles"


class Relocaliser:
    """One search: feed it views until it answers.

    >>> relocaliser = Relocaliser(trunks_map, RelocaliseConfig(), seed=1)
    >>> answer = relocaliser.look(trunks_body, step_body, turn_rad)
    """

    def __init__(self, trunks_map: Array, config: RelocaliseConfig, *, seed: int) -> None:
        self.config = config
        self._known: Constellation = constellation(trunks_map, config.constellation)
        self._field: LikelihoodField | None = None  # costs more than most searches: made when it is needed
        self._rng = np.random.default_rng(seed)
        self._particles: Particles | None = None
        self._fits: list[float] = []
        self.views = 0

    def look(self, trunks_body: Array, step_body: Array, turn_rad: float) -> Answer | None:
        """Take in a view (N, 2), m, and the motion since the last one; None: not sure yet."""
        config = self.config
        self.views += 1
        view = constellation(trunks_body, config.constellation)
        places = match(self._known, view, config.constellation)
        best = accepted(places, config.constellation)
        if best is not None:
            return Answer(best.p_map, best.yaw, self.views, "constellation")
        if self._particles is not None:
            self._particles.move(self._rng, step_body, turn_rad)
        elif places:
            self._particles = self._about(places)
        if self._particles is None or len(trunks_body) < config.least_trunks:
            return None
        if self._field is None:
            self._field = LikelihoodField(self._known.centers, config.particles)
        self._particles.see(self._field, trunks_body)
        return self._judge(trunks_body)

    def _about(self, places: list[Place]) -> Particles:
        config = self.config
        poses = np.repeat(np.array([[*p.p_map, p.yaw] for p in places]), config.per_place, axis=0)
        spread = np.array([config.spread_m, config.spread_m, config.spread_rad])
        return Particles(poses + self._rng.normal(size=poses.shape) * spread, config.particles)

    def _judge(self, trunks_body: Array) -> Answer | None:
        """The one place that holds the particles, if views long enough have fitted it."""
        assert self._particles is not None
        config = self.config
        pose, share = self._particles.mean_near(config.together_m)
        self._fits.append(self._fit(pose, trunks_body))
        self._particles.resample(self._rng, min(len(self._particles.poses), config.kept))
        recent = self._fits[-config.least_views :]
        if len(recent) < config.least_views or share < config.sure_share:
            return None
        if float(np.mean(recent)) < config.least_fit:
            self._particles, self._fits = None, []  # none of the places was right: begin again
            return None
        return Answer(pose[:2], float(pose[2]), self.views, "particles")

    def _fit(self, pose: Array, trunks_body: Array) -> float:
        """Share of the view's trunks that have one of the map near them."""
        placed = Place(pose[:2], float(pose[2]), 0, 0.0, 0.0).to_map(trunks_body)
        if self._known.trunk_tree is None:
            return 0.0
        gaps, _ = self._known.trunk_tree.query(placed, distance_upper_bound=self.config.fit_m)
        return float(np.isfinite(gaps).mean())
