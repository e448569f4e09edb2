"""The linear Kalman filter, for states that add: tracks of things that move, markers, heights.

Source: R. E. Kalman, "A New Approach to Linear Filtering and Prediction Problems", 1960; the
update in Joseph's form (R. Bucy and P. Joseph, 1968), which keeps a covariance symmetric and
positive whatever the gain.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from companion.core.messages import Array


@dataclass(frozen=True, slots=True)
class Innovation:
    """What a measurement said beyond the prediction."""

    residual: Array  # (m,)
    covariance: Array  # (m, m), of the residual, by the filter's own word

    @property
    def nis(self) -> float:
        """Normalised innovation squared: chi-square with m degrees of freedom if all is well."""
        return float(self.residual @ np.linalg.solve(self.covariance, self.residual))


@dataclass(slots=True)
class KalmanFilter:
    """Mean x (n,) and covariance P (n, n) of a Gaussian belief.

    >>> kf = KalmanFilter(np.zeros(6), np.eye(6))
    >>> kf.predict(*constant_velocity(0.1, accel_density=1.0, axes=3))
    >>> kf.update(z, H, noise)
    """

    x: Array
    P: Array

    def predict(self, F: Array, Q: Array) -> None:
        """x' = F x with process noise of covariance Q, (n, n) both."""
        self.x = F @ self.x
        self.P = F @ self.P @ F.T + Q

    def innovation(self, z: Array, H: Array, noise: Array) -> Innovation:
        """What z (m,) = H x + noise would say; changes nothing, so it serves as a gate."""
        return Innovation(z - H @ self.x, H @ self.P @ H.T + noise)

    def update(self, z: Array, H: Array, noise: Array) -> Innovation:
        """Take the measurement z (m,) = H x + noise of covariance (m, m)."""
        said = self.innovation(z, H, noise)
        K = gain(self.P, H, said.covariance)
        self.x = self.x + K @ said.residual
        self.P = joseph(self.P, K, H, noise)
        return said


def gain(P: Array, H: Array, S: Array) -> Array:
    """P H' S^-1, (n, m)."""
    K: Array = np.linalg.solve(S, H @ P).T.astype(np.float64, copy=False)
    return K


def joseph(P: Array, K: Array, H: Array, noise: Array) -> Array:
    """Covariance (n, n) after an update with the gain K (n, m)."""
    A = np.eye(len(P)) - K @ H
    updated = A @ P @ A.T + K @ noise @ K.T
    return 0.5 * (updated + updated.T)


def constant_velocity(dt_s: float, *, accel_density: float, axes: int) -> tuple[Array, Array]:
    """F and Q (2 axes, 2 axes) of a point whose velocity does a random walk; x holds positions, then velocities.

    `accel_density` is the power density of the white acceleration, (m/s2)^2/Hz = m2/s3. Source:
    Y. Bar-Shalom et al., "Estimation with Applications to Tracking and Navigation", 2001, eq. 6.2.2-12.
    """
    one = np.eye(axes)
    F = np.block([[one, dt_s * one], [0.0 * one, one]])
    Q = np.block([[dt_s**3 / 3 * one, dt_s**2 / 2 * one], [dt_s**2 / 2 * one, dt_s * one]])
    return F, accel_density * Q
