"""Monte Carlo localisation: where among known points may the vehicle be, when more than one place fits.

Source: F. Dellaert et al., "Monte Carlo Localization for Mobile Robots", ICRA 1999; likelihood
field: S. Thrun et al., "Probabilistic Robotics", 2005, sec. 6.4; low-variance resampling: sec. 4.3.
"""

from __future__ import annotations

import math
from typing import Annotated

import msgspec
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from companion.core.errors import InputError
from companion.core.messages import Array, Array32

Positive = Annotated[float, msgspec.Meta(gt=0)]
Share = Annotated[float, msgspec.Meta(gt=0, lt=1)]


class ParticleConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """How a view is judged, and how particles spread."""

    cell_m: Positive = 0.1  # of the likelihood field
    sigma_m: Positive = 0.2  # of a point of the view about its counterpart
    chance: Share = 0.03  # likelihood of a point that has none, over that of one that fits exactly
    move_sigma_m: Positive = 0.05  # of a step ...
    move_share: Annotated[float, msgspec.Meta(ge=0)] = 0.05  # ... plus this share of it
    turn_sigma_rad: Positive = 0.01
    resample_below: Share = 0.5  # effective share of the particles that is left


class LikelihoodField:
    """Log-likelihood of a seen point, by where it would lie among known points (N, 2), m."""

    def __init__(self, known: Array, config: ParticleConfig) -> None:
        if len(known) == 0:
            raise InputError("no point is known", field="known", valid="at least one")
        self._cell_m, self._margin_m = config.cell_m, 4.0 * config.sigma_m + config.cell_m
        self._corner = known.min(axis=0) - self._margin_m
        size = np.ceil((np.ptp(known, axis=0) + 2.0 * self._margin_m) / config.cell_m).astype(int) + 1
        free = np.ones(tuple(size.tolist()), bool)
        cell = self._cells(known)
        free[cell[:, 0], cell[:, 1]] = False
        gap_m = ndimage.distance_transform_edt(free) * config.cell_m
        fit = np.exp(-0.5 * (gap_m / config.sigma_m) ** 2)
        self._lost = math.log(config.chance)
        self._table: Array32 = np.log((1.0 - config.chance) * fit + config.chance).astype(np.float32)

    def at(self, points: Array) -> Array:
        """Log-likelihoods (...) of points (..., 2); beyond the field that of chance."""
        cell = self._cells(points)
        inside = np.all((cell >= 0) & (cell < self._table.shape), axis=-1)
        i, j = np.where(inside, cell[..., 0], 0), np.where(inside, cell[..., 1], 0)
        values: Array = np.where(inside, self._table[i, j], self._lost)
        return values

    def _cells(self, points: Array) -> NDArray[np.int64]:
        cells: NDArray[np.int64] = np.floor((points - self._corner) / self._cell_m).astype(np.int64)
        return cells


class Particles:
    """Poses (x, y, yaw) with weights; every call that draws takes its generator.

    >>> particles = Particles(poses, config)
    >>> particles.move(rng, step_body, turn_rad)
    >>> particles.see(field, view_body)
    """

    def __init__(self, poses: Array, config: ParticleConfig) -> None:
        self.config = config
        self.poses = np.array(poses, np.float64).reshape(-1, 3)
        self.weights = np.full(len(self.poses), 1.0 / max(len(self.poses), 1))

    def move(self, rng: np.random.Generator, step: Array, turn: float) -> None:
        """Each takes the step (2,), m, in its own frame, and the turn, rad, with noise of its own."""
        config, count = self.config, len(self.poses)
        sigma = config.move_sigma_m + config.move_share * float(np.hypot(*step))
        steps = step + rng.normal(0.0, sigma, (count, 2))
        self.poses[:, :2] += _turned(steps[:, None], self.poses[:, 2])[:, 0]
        self.poses[:, 2] += turn + rng.normal(0.0, config.turn_sigma_rad, count)

    def see(self, field: LikelihoodField, view: Array) -> None:
        """Weigh each by how the view (M, 2), m, in its own frame, fits what is known."""
        placed = _turned(np.broadcast_to(view, (len(self.poses), *view.shape)), self.poses[:, 2])
        fit = field.at(placed + self.poses[:, None, :2]).sum(axis=1) + np.log(np.maximum(self.weights, 1e-300))
        weights = np.exp(fit - fit.max())
        self.weights = weights / weights.sum()

    def resample(self, rng: np.random.Generator, count: int | None = None) -> bool:
        """Draw `count` (default: as many as now) by weight, once few of them matter; whether it was done."""
        wanted = len(self.poses) if count is None else count
        if self.effective > self.config.resample_below * len(self.poses) and wanted == len(self.poses):
            return False
        pointers = (np.arange(wanted) + rng.random()) / wanted
        chosen = np.minimum(np.searchsorted(np.cumsum(self.weights), pointers), len(self.poses) - 1)
        self.poses, self.weights = self.poses[chosen], np.full(wanted, 1.0 / wanted)
        return True

    @property
    def effective(self) -> float:
        """Number of particles that matter (J. Liu 1996)."""
        return float(1.0 / np.sum(self.weights**2))

    def mean_near(self, radius_m: float) -> tuple[Array, float]:
        """Mean pose (3,) of those within `radius_m` of the heaviest place, and their share of the weight."""
        best = self.poses[int(np.argmax(self.weights))]
        near = np.linalg.norm(self.poses[:, :2] - best[:2], axis=1) <= radius_m
        weights = self.weights[near] / self.weights[near].sum()
        place = weights @ self.poses[near, :2]
        yaw = math.atan2(weights @ np.sin(self.poses[near, 2]), weights @ np.cos(self.poses[near, 2]))
        return np.array([place[0], place[1], yaw]), float(self.weights[near].sum())


def _turned(points: Array, yaw: Array) -> Array:
    """Points (N, M, 2), each set turned by its yaw (N,)."""
    c, s = np.cos(yaw)[:, None], np.sin(yaw)[:, None]
    return np.stack([c * points[..., 0] - s * points[..., 1], s * points[..., 0] + c * points[..., 1]], axis=-1)
