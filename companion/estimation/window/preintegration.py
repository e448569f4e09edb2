"""IMU between two nodes of a window: what was measured, once, and what it says of two states, again and again.

Source: C. Forster et al., "On-Manifold Preintegration for Real-Time Visual-Inertial Odometry", T-RO 2017, sec. VI;
steps and noise are those of `companion.estimation.propagation`, so that filter and window mean the same.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from companion.core.messages import Array
from companion.estimation.so3 import exp_into, multiply_into
from companion.estimation.state import State

NODE_ERROR = 15  # theta_body, p, v, gyro bias, accelerometer bias
_SHORTEST_M2 = 1e-10  # variance of position over one single piece, which moves no velocity before


@dataclass(frozen=True, slots=True)
class Preintegrated:
    """Motion in the frame of its begin, for the biases that were taken then."""

    seconds: float
    dR: Array  # (3, 3)
    dp: Array  # (3,), without gravity and the velocity of the begin
    dv: Array  # (3,)
    biases: Array  # gyro, accelerometer, (6,)
    by_biases: Array  # d (theta, dp, dv) / d biases, (9, 6)
    root: Array  # upper triangular U, U' U = information of the residual, (15, 15)


@dataclass(frozen=True, slots=True)
class ImuResidual:
    """Whitened residual (15,) and its Jacobians by the errors of both states and by gravity."""

    r: Array
    by_first: Array  # (15, 15)
    by_second: Array  # (15, 15)
    by_gravity: Array  # (15, 3)

    @property
    def equations(self) -> tuple[Array, Array]:
        """Normal equations of both states and gravity, (33, 33) and (33,)."""
        J = np.hstack([self.by_first, self.by_second, self.by_gravity])
        return J.T @ J, -J.T @ self.r


def preintegrate(imu: Array, biases: Array, densities: Array, *, hidden: Array | None = None) -> Preintegrated:
    """Pieces (N, 7) of dt, rate, specific force; biases (6,); densities (4,) of `ImuNoise`.

    `hidden` (9, 9): covariance of what the pieces do not tell of attitude, position and velocity, as in a gap.
    """
    dR, moved = np.eye(3), np.zeros(6)
    F, S = np.eye(NODE_ERROR), np.zeros((NODE_ERROR, NODE_ERROR))
    _preintegrate(np.ascontiguousarray(imu), biases, densities, dR, moved, F, S)
    S[np.arange(3, 6), np.arange(3, 6)] += _SHORTEST_M2
    if hidden is not None:
        S[:9, :9] += hidden
    root = np.linalg.cholesky(np.linalg.inv(0.5 * (S + S.T))).T
    seconds = float(imu[:, 0].sum())
    return Preintegrated(seconds, dR, moved[:3], moved[3:], biases.copy(), F[:9, 9:].copy(), root)


def imu_residual(pre: Preintegrated, first: State, second: State, g: Array) -> ImuResidual:
    """Of two states, with gravity g (3,) in odom; Forster et al., eq. 45 with theta, p, v, biases in this order."""
    r, A = np.empty(NODE_ERROR), np.zeros((NODE_ERROR, NODE_ERROR))
    B, G = np.zeros((NODE_ERROR, NODE_ERROR)), np.zeros((NODE_ERROR, 3))
    motion = pre.dR, pre.dp, pre.dv, pre.biases, pre.by_biases
    _residual(motion, pre.seconds, first.x, second.x, g, (r, A, B, G))
    return ImuResidual(pre.root @ r, pre.root @ A, pre.root @ B, pre.root @ G)


@njit(cache=True, nogil=True)
def _preintegrate(imu, biases, densities, dR, moved, F, S):  # type: ignore[no-untyped-def]
    half, middle, step = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    for k in range(imu.shape[0]):
        dt, w, f = imu[k, 0], imu[k, 1:4] - biases[:3], imu[k, 4:7] - biases[3:]
        exp_into(0.5 * w[0] * dt, 0.5 * w[1] * dt, 0.5 * w[2] * dt, half)
        multiply_into(dR, half, middle)  # the force is a mean: it belongs to the attitude halfway
        multiply_into(half, half, step)
        h, a = half @ f, middle @ f
        E = _transition(dt, h, dR, middle, step)
        F[:] = E @ F
        S[:] = E @ S @ E.T
        for i in range(3):
            S[i, i] += densities[0] * dt
            S[6 + i, 6 + i] += densities[1] * dt
            S[9 + i, 9 + i] += densities[2] * dt
            S[12 + i, 12 + i] += densities[3] * dt
            moved[i] += moved[3 + i] * dt + 0.5 * a[i] * dt * dt
            moved[3 + i] += a[i] * dt
        multiply_into(middle, half, step)
        dR[:] = step


@njit(cache=True, nogil=True)
def _transition(dt, h, dR, middle, step):  # type: ignore[no-untyped-def]
    """Of the errors (15, 15) over one piece, as in `propagation._transition`."""
    E = np.eye(15)
    A = -dR @ _skew(h)
    E[:3, :3] = step.T
    E[6:9, :3], E[6:9, 9:12], E[6:9, 12:] = dt * A, -0.5 * dt * dt * A, -dt * middle
    for i in range(3):
        E[i, 9 + i] = -dt
        E[3 + i, 6 + i] = dt
    E[3:6, :3], E[3:6, 9:] = 0.5 * dt * E[6:9, :3], 0.5 * dt * E[6:9, 9:]
    return E


@njit(cache=True, nogil=True)
def _residual(motion, T, x, y, g, out):  # type: ignore[no-untyped-def]
    (dR, dp, dv, biases, by), (r, A, B, G) = motion, out
    Ri, Rj = x[:9].copy().reshape((3, 3)), y[:9].copy().reshape((3, 3))
    RiT = np.ascontiguousarray(Ri.T)
    off = x[15:21] - biases
    shift = by @ off
    turn = np.empty((3, 3))
    exp_into(shift[0], shift[1], shift[2], turn)
    theta = _log((dR @ turn).T @ RiT @ Rj)
    p = RiT @ (y[9:12] - x[9:12] - x[12:15] * T - 0.5 * T * T * g)
    v = RiT @ (y[12:15] - x[12:15] - T * g)
    r[:3], r[3:6], r[6:9], r[9:] = theta, p - dp - shift[3:6], v - dv - shift[6:9], y[15:21] - x[15:21]
    inverse = _right_inverse(theta)
    exp_into(-theta[0], -theta[1], -theta[2], turn)
    A[:3, :3], B[:3, :3] = -inverse @ np.ascontiguousarray(Rj.T) @ Ri, inverse
    A[:3, 9:] = -inverse @ turn @ np.ascontiguousarray(by[:3])
    A[3:6, :3], A[6:9, :3] = _skew(p), _skew(v)
    A[3:6, 3:6], A[6:9, 6:9], A[3:6, 6:9] = -RiT, -RiT, -T * RiT
    A[3:9, 9:] = -by[3:]
    B[3:6, 3:6], B[6:9, 6:9] = RiT, RiT
    G[3:6], G[6:9] = -0.5 * T * T * RiT, -T * RiT
    for i in range(9, 15):
        A[i, i], B[i, i] = -1.0, 1.0


@njit(cache=True, nogil=True)
def _skew(v):  # type: ignore[no-untyped-def]
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


@njit(cache=True, nogil=True)
def _log(R):  # type: ignore[no-untyped-def]
    """Rotation vector of R, away from half a turn."""
    axis = 0.5 * np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
    sine = np.sqrt((axis * axis).sum())
    if sine < 1e-9:
        return axis
    return axis * (np.arctan2(sine, 0.5 * (R[0, 0] + R[1, 1] + R[2, 2] - 1.0)) / sine)


@njit(cache=True, nogil=True)
def _right_inverse(theta):  # type: ignore[no-untyped-def]
    """Inverse of the right Jacobian of SO(3), to the third order: residuals are small."""
    K = _skew(theta)
    return np.eye(3) + 0.5 * K + K @ K / 12.0
