"""Monte Carlo localisation in a prior map: particles of position and heading, their number as large as need be.

Source: F. Dellaert et al., "Monte Carlo Localization for Mobile Robots", ICRA 1999; number of
particles: D. Fox, "Adapting the Sample Size in Particle Filters Through KLD-Sampling", IJRR 2003;
recovery by random particles: S. Thrun et al., "Probabilistic Robotics", 2005, table 8.3.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

import msgspec
import numpy as np
from numba import njit
from numpy.typing import NDArray

from companion.core.messages import Array
from companion.estimation.mcl.prior_map import FieldModel, PriorMap, Share

Positive = Annotated[float, msgspec.Meta(gt=0)]
NotNegative = Annotated[float, msgspec.Meta(ge=0)]
Count = Annotated[int, msgspec.Meta(ge=2)]
_BIN_RANGE = 1 << 18  # bins along an axis
_QUANTILE_99 = 2.326  # of the standard normal distribution


class MclConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Motion noise per step, bounds of the number of particles, and recovery."""

    model: FieldModel = FieldModel()
    move_sigma_m: NotNegative = 0.02  # of a step ...
    move_share: NotNegative = 0.1  # ... plus this share of its length
    climb_sigma_m: NotNegative = 0.0  # of a step's height; 0 keeps a plan's particles at their height
    turn_sigma_rad: NotNegative = 0.01
    fewest: Count = 300
    most: Count = 50_000
    kld_error: Positive = 0.05  # of the distribution over bins, with 99 % certainty
    bin_m: Positive = 0.5
    bin_rad: Positive = 0.175
    resample_below: Annotated[float, msgspec.Meta(gt=0, le=1)] = 0.5  # effective share that is left
    slow_rate: NotNegative = 0.05  # of the running means of the fit; 0 leaves recovery out
    fast_rate: NotNegative = 0.4
    lost_above: Share = 0.15  # fall of the fit at which particles are thrown anew


@dataclass(frozen=True, slots=True)
class MclEstimate:
    """Where the particles are."""

    pose: Array  # mean x, y, z, yaw, (4,)
    covariance: Array  # (4, 4)
    share: float  # of the weight within `radius_m` of the mean


class MonteCarlo:
    """Poses (N, 4) x, y, z, yaw with weights; each call that draws takes its generator.

    >>> mcl = MonteCarlo(poses, plan, MclConfig())
    >>> mcl.move(rng, step_body, turn_rad)
    >>> mcl.see(points_level)
    >>> mcl.resample(rng, elsewhere)
    """

    def __init__(self, poses: Array, prior: PriorMap, config: MclConfig) -> None:
        self.config, self._prior = config, prior
        self._table = prior.log_likelihood(config.model)
        self.poses = np.array(poses, np.float64).reshape(-1, 4)
        self.weights = np.full(len(self.poses), 1.0 / len(self.poses))
        self._slow = self._fast = 0.0

    def move(self, rng: np.random.Generator, step_body: Array, turn_rad: float) -> None:
        """Each takes the step (3,), m, in its own level frame, then the turn, with noise of its own."""
        c, count = self.config, len(self.poses)
        sigma = c.move_sigma_m + c.move_share * float(np.linalg.norm(step_body))
        steps = step_body[:2] + rng.normal(0.0, 1.0, (count, 2)) * sigma
        cos, sin = np.cos(self.poses[:, 3]), np.sin(self.poses[:, 3])
        self.poses[:, 0] += cos * steps[:, 0] - sin * steps[:, 1]
        self.poses[:, 1] += sin * steps[:, 0] + cos * steps[:, 1]
        self.poses[:, 2] += step_body[2] + rng.normal(0.0, 1.0, count) * c.climb_sigma_m
        self.poses[:, 3] += turn_rad + rng.normal(0.0, 1.0, count) * c.turn_sigma_rad

    def see(self, points_level: Array) -> float:
        """Weigh by a scan (M, 3) in the level frame of the vehicle; returns the mean fit of a point, 0..1."""
        if not len(points_level):
            return 1.0
        model = self.config.model
        temper = min(1.0, model.independent / len(points_level))
        sums = np.empty(len(self.poses))
        place = (self._prior.corner, 1.0 / self._prior.cell_m, math.log(model.chance))
        _fit(self.poses, np.ascontiguousarray(points_level), self._table, place, sums)
        scaled = temper * sums + np.log(np.maximum(self.weights, 1e-300))
        weights = np.exp(scaled - scaled.max())
        self.weights = weights / weights.sum()
        # Of those that remain: random particles thrown for recovery must not look like bad luck.
        fit = float(self.weights @ np.exp(sums / len(points_level)))
        c = self.config
        self._slow += (c.slow_rate if self._slow else 1.0) * (fit - self._slow)
        self._fast += (c.fast_rate if self._fast else 1.0) * (fit - self._fast)
        return fit

    def resample(self, rng: np.random.Generator, elsewhere: Array | None = None) -> bool:
        """Draw by weight, as many as the spread over bins asks for; whether it was done.

        `elsewhere` (K, 4): poses to draw from when the fit has fallen below what it was: up to
        `most` of them, beside the others, since one in thousands comes near enough to be right.
        """
        lost = self.lost_share if elsewhere is not None else 0.0
        if lost <= self.config.lost_above and self.effective > self.config.resample_below * len(self.poses):
            return False
        drawn = self._by_weight(rng, self._enough(rng))
        if elsewhere is not None and lost > self.config.lost_above:
            fresh = elsewhere[rng.integers(0, len(elsewhere), int(lost * self.config.most))]
            drawn = np.concatenate([drawn, fresh])
        self.poses, self.weights = drawn, np.full(len(drawn), 1.0 / len(drawn))
        return True

    @property
    def lost_share(self) -> float:
        """Share of particles to be thrown anew: how far the recent fit is below the lasting one."""
        return max(0.0, 1.0 - self._fast / self._slow) if self.config.slow_rate and self._slow else 0.0

    @property
    def effective(self) -> float:
        """Number of particles that matter (J. Liu, 1996)."""
        return float(1.0 / np.sum(self.weights**2))

    def estimate(self, *, radius_m: float = 1.0) -> MclEstimate:
        """Mean and covariance of those around the heaviest place, and its share of the weight."""
        best = self.poses[self._heaviest()]
        near = np.linalg.norm(self.poses[:, :3] - best[:3], axis=1) <= radius_m
        weights = self.weights[near]
        share = float(weights.sum())
        off = self.poses[near] - best
        off[:, 3] = np.arctan2(np.sin(off[:, 3]), np.cos(off[:, 3]))
        mean = weights @ off / share
        spread = (off - mean).T @ ((off - mean) * weights[:, None]) / share
        return MclEstimate(best + mean, spread, share)

    def _heaviest(self) -> int:
        """A particle of the bin that holds the most weight."""
        _, place = np.unique(self._bins(self.poses), return_inverse=True)
        fullest = int(np.argmax(np.bincount(place, weights=self.weights)))
        return int(np.argmax(np.where(place == fullest, self.weights, -1.0)))

    def _bins(self, poses: Array) -> NDArray[np.int64]:
        """One whole number per pose, the same for those of one bin, (N,)."""
        c = self.config
        cells = np.floor(poses[:, :3] / c.bin_m).astype(np.int64) + _BIN_RANGE // 2
        turn = np.floor(np.mod(poses[:, 3], 2.0 * math.pi) / c.bin_rad).astype(np.int64)
        bins: NDArray[np.int64] = ((turn * _BIN_RANGE + cells[:, 0]) * _BIN_RANGE + cells[:, 1]) * _BIN_RANGE + cells[
            :, 2
        ]
        return bins

    def _enough(self, rng: np.random.Generator) -> int:
        """Particles for the bins that a first draw by weight occupies (Fox 2003, eq. 7)."""
        c = self.config
        first = self._by_weight(rng, min(len(self.poses), c.most))
        return kld_count(len(np.unique(self._bins(first))), c)

    def _by_weight(self, rng: np.random.Generator, count: int) -> Array:
        """Low-variance resampling."""
        pointers = (np.arange(count) + rng.random()) / count
        chosen = np.minimum(np.searchsorted(np.cumsum(self.weights), pointers), len(self.poses) - 1)
        return self.poses[chosen]


def kld_count(bins: int, config: MclConfig) -> int:
    """Particles that keep the Kullback-Leibler distance over `bins` occupied bins below `kld_error`."""
    if bins < 2:
        return config.fewest
    a = 2.0 / (9.0 * (bins - 1))
    wanted = (bins - 1) / (2.0 * config.kld_error) * (1.0 - a + math.sqrt(a) * _QUANTILE_99) ** 3
    return int(min(max(math.ceil(wanted), config.fewest), config.most))


@njit(cache=True, nogil=True)
def _fit(poses, points, table, place, sums):  # type: ignore[no-untyped-def]
    """Sum over the points of their log-likelihood, for each pose."""
    corner, per_m, beyond = place
    nx, ny, nz = table.shape
    flat = nz == 1
    for n in range(poses.shape[0]):
        cos, sin = math.cos(poses[n, 3]), math.sin(poses[n, 3])
        x0, y0, z0 = poses[n, 0] - corner[0], poses[n, 1] - corner[1], poses[n, 2] - corner[2]
        total = 0.0
        for m in range(points.shape[0]):
            i = np.int64(math.floor((cos * points[m, 0] - sin * points[m, 1] + x0) * per_m))
            j = np.int64(math.floor((sin * points[m, 0] + cos * points[m, 1] + y0) * per_m))
            k = 0 if flat else np.int64(math.floor((points[m, 2] + z0) * per_m))
            if 0 <= i < nx and 0 <= j < ny and 0 <= k < nz:
                total += table[i, j, k]
            else:
                total += beyond
        sums[n] = total
