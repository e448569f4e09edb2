"""Iterated error-state Kalman filter: predict with the IMU, update with normal equations."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from companion.core.geometry import log_so3
from companion.core.messages import Array
from companion.estimation.normal import Normal
from companion.estimation.propagation import propagate
from companion.estimation.state import ERROR, State

Linearise = Callable[[Array, Array], Normal]


@dataclass(slots=True)
class Filter:
    """State, covariance (18, 18) in the order of `State.minus`, and time."""

    state: State
    P: Array
    t_s: float
    surprise: float = 0.0  # squared Mahalanobis distance from the prior to the last update

    def predict(self, imu: Array, densities: Array) -> Array:
        """Run IMU pieces (N, 7) through the filter; returns the nodes passed, (N, 22)."""
        nodes = propagate(self.state, self.P, imu, densities, t_s=self.t_s)
        self.t_s += float(imu[:, 0].sum())
        return nodes

    def update(
        self,
        linearise: Linearise,
        *,
        iterations: int,
        at_least: int,
        begin: tuple[Array, Array] | None = None,
    ) -> Normal:
        """Gauss-Newton on prior + measurement; nothing changes if fewer than `at_least` are used.

        `begin` = (R, p): where iteration begins, if not at the prior's mean.
        Returns the normal equations of the last iteration. The prior's Jacobian is taken as
        the identity, since corrections are far below 0.1 rad.
        """
        prior = self.state.copy()
        information = np.linalg.inv(self.P)
        if begin is not None:
            self.state.R[:], self.state.p[:] = begin
        for _ in range(iterations):
            normal = linearise(self.state.R, self.state.p)
            if normal.used < at_least:
                self.state.x[:] = prior.x
                return normal
            posterior = information.copy()
            posterior[:6, :6] += normal.H
            right = -information @ self.state.minus(prior)
            right[:6] += normal.g
            step = np.linalg.solve(posterior, right)
            self.state.retract(step)
            if is_small(step):
                break
        moved = self.state.minus(prior)
        self.surprise = float(moved @ information @ moved)
        P = np.linalg.inv(posterior)
        self.P = 0.5 * (P + P.T)
        return normal

    def hold(self, R: Array, p: Array, *, sigmas: Array) -> None:
        """The pose is known to be (R, p) still, and the velocity zero.

        `sigmas` (9,): rad, m, m/s, of theta_body, p and v. A plain Kalman update: errors are tiny at rest.
        """
        error = np.concatenate([log_so3(self.state.R.T @ R), p - self.state.p, -self.state.v])
        gain = np.linalg.solve(self.P[:9, :9] + np.diag(sigmas**2), self.P[:9]).T
        self.state.retract(gain @ error)
        P = self.P - gain @ self.P[:9]
        self.P = 0.5 * (P + P.T)

    @property
    def is_sound(self) -> bool:
        """Finite, with positive variances."""
        finite = np.isfinite(self.state.x).all() and np.isfinite(self.P).all()
        return bool(finite and (self.P.diagonal() > 0).all())


def start_covariance(R: Array, *, tilt_sigma_m_s2: float, sigmas: StartSigmas) -> Array:
    """Covariance at rest: the attitude is exact by definition, gravity is what is unknown.

    At rest the accelerometer reads f = R'(-g) + ba, so an error of the bias is an error of
    gravity, dg = R dba, in the horizontal plane; along the vertical |g| is known.
    """
    P = np.zeros((ERROR, ERROR))
    P[:6, :6] = np.eye(6) * 1e-8
    P[6:9, 6:9] = np.eye(3) * sigmas.velocity_m_s**2
    P[9:12, 9:12] = np.eye(3) * sigmas.gyro_bias_rad_s**2
    bias_odom = np.diag([tilt_sigma_m_s2**2, tilt_sigma_m_s2**2, sigmas.vertical_bias_m_s2**2])
    horizontal = np.diag([1.0, 1.0, 0.0])
    P[12:15, 12:15] = R.T @ bias_odom @ R
    P[15:18, 12:15] = horizontal @ bias_odom @ R
    P[12:15, 15:18] = P[15:18, 12:15].T
    P[15:18, 15:18] = horizontal @ bias_odom @ horizontal + np.diag([1e-5, 1e-5, 1e-8])
    return P


@dataclass(frozen=True, slots=True)
class StartSigmas:
    """What standing still for a second tells."""

    velocity_m_s: float = 1e-2
    gyro_bias_rad_s: float = 2e-3
    vertical_bias_m_s2: float = 2e-2


def is_small(step: Array) -> bool:
    """Whether a correction (6+,), rad and m first, ends the iteration."""
    return bool(np.linalg.norm(step[:3]) < 1e-4 and np.linalg.norm(step[3:6]) < 1e-3)
