"""The unscented Kalman filter with the models of the extended one; no Jacobian is asked for.

Source: S. Julier and J. Uhlmann, "Unscented Filtering and Nonlinear Estimation", Proc. IEEE
2004. Noise is additive: that of the IMU over a batch of samples comes from the linear model.
"""

from __future__ import annotations

import numpy as np

from companion.core.messages import Array
from companion.estimation.filter import Filter, Linearise, is_small
from companion.estimation.filters.kalman import Innovation
from companion.estimation.filters.measurements import Measurement
from companion.estimation.filters.sigma_points import (
    POINTS,
    errors_about,
    move_to_mean,
    propagate_points,
    spread,
)
from companion.estimation.normal import Normal
from companion.estimation.propagation import propagate
from companion.estimation.state import ERROR, State

_WEAKEST = 1e-6  # eigenvalues of a registration below this say nothing


class UnscentedFilter(Filter):
    """36 sigma points carry mean and covariance through motion and measurements."""

    def predict(self, imu: Array, densities: Array) -> Array:
        """Run IMU pieces (N, 7) through the filter; returns the nodes passed, (N, 22)."""
        points = spread(self.state, self.P)
        noise = np.zeros((ERROR, ERROR))
        nodes = propagate(self.state, noise, imu, densities, t_s=self.t_s)
        propagate_points(points, imu)
        errors = move_to_mean(points, self.state)
        self.P = errors.T @ errors / POINTS + 0.5 * (noise + noise.T)
        self.t_s += float(imu[:, 0].sum())
        return nodes

    def correct(self, measurement: Measurement, *, gate_nis: float = np.inf) -> Innovation:
        """Take a measurement, unless its normalised innovation squared exceeds `gate_nis`."""
        points = spread(self.state, self.P)
        seen = np.array([measurement.expected(State(x)) for x in points])
        said, step, P = _joint(errors_about(points, self.state), seen, measurement.z, measurement.noise, self.P)
        if said.nis <= gate_nis:
            self.state.retract(step)
            self.P = P
        return said

    def update(
        self,
        linearise: Linearise,
        *,
        iterations: int,
        at_least: int,
        begin: tuple[Array, Array] | None = None,
    ) -> Normal:
        """As `Filter.update`: the registration at each iterate, seen by the prior's sigma points.

        Normal equations at a pose are a linear measurement of the pose about it: with
        H = V diag(s) V', z = s^(-1/2) V' g of s^(1/2) V' (pose minus linearisation), noise 1.
        """
        prior = self.state.copy()
        points = spread(prior, self.P)
        errors = errors_about(points, prior)
        if begin is not None:
            self.state.R[:], self.state.p[:] = begin
        for _ in range(iterations):
            normal = linearise(self.state.R, self.state.p)
            if normal.used < at_least:
                self.state.x[:] = prior.x
                return normal
            A, z = whitened(normal)
            at = self.state.copy()
            seen = errors_about(points, at)[:, :6] @ A.T
            _, step, P = _joint(errors, seen, z, np.eye(len(z)), self.P)
            self.state.x[:] = prior.x
            self.state.retract(step)
            if is_small(self.state.minus(at)):
                break
        corrected = self.state.minus(prior)
        self.surprise = float(corrected @ np.linalg.solve(self.P, corrected))
        self.P = P
        return normal


def whitened(normal: Normal) -> tuple[Array, Array]:
    """A (m, 6) and z (m,) with A' A = H and A' z = g, without the directions of which H says nothing."""
    values, vectors = np.linalg.eigh(0.5 * (normal.H + normal.H.T))
    kept = values > _WEAKEST * max(float(values[-1]), 1e-12)
    root = np.sqrt(values[kept])
    return root[:, None] * vectors[:, kept].T, vectors[:, kept].T @ normal.g / root


def _joint(errors: Array, seen: Array, z: Array, noise: Array, P: Array) -> tuple[Innovation, Array, Array]:
    """Innovation, correction (18,) and covariance (18, 18) after it, from errors (N, 18) and what they see (N, m)."""
    mean = seen.mean(axis=0)
    off = seen - mean
    S = off.T @ off / len(seen) + noise
    cross = errors.T @ off / len(seen)
    K = np.linalg.solve(S, cross.T).T
    updated = P - K @ S @ K.T
    return Innovation(z - mean, S), K @ (z - mean), 0.5 * (updated + updated.T)
