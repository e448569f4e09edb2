"""Strapdown propagation of state and covariance, with a log of nodes for deskewing.

Source: J. Sola, "Quaternion kinematics for the error-state Kalman filter", 2017, ch. 5 and 7
(local angular error, biases and gravity in the state).
"""

from __future__ import annotations

from typing import Annotated

import msgspec
import numpy as np
from numba import njit

from companion.core.messages import Array
from companion.estimation.so3 import exp_into, multiply_into
from companion.estimation.state import State

Positive = Annotated[float, msgspec.Meta(gt=0)]
NODE = 22  # t, R (9), p (3), v (3), body rate (3), acceleration in odom (3)


class ImuNoise(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Densities of the IMU; the defaults fit a BMI088 on a vibrating airframe."""

    gyro_rad_s_sqrt_hz: Positive = 1e-3
    accel_m_s2_sqrt_hz: Positive = 3e-2
    gyro_walk_rad_s2_sqrt_hz: Positive = 4e-5
    accel_walk_m_s3_sqrt_hz: Positive = 1e-3

    @property
    def densities(self) -> Array:
        """Power densities in the order gyro, accel, gyro walk, accel walk, (4,)."""
        sigmas = (
            self.gyro_rad_s_sqrt_hz,
            self.accel_m_s2_sqrt_hz,
            self.gyro_walk_rad_s2_sqrt_hz,
            self.accel_walk_m_s3_sqrt_hz,
        )
        return np.array([sigma**2 for sigma in sigmas])


def propagate(state: State, P: Array, imu: Array, densities: Array, *, t_s: float) -> Array:
    """Run IMU samples through `state` and `P` (18, 18), both in place.

    `imu` (N, 7) holds dt, body rate and specific force, each the mean over its interval;
    `densities` (4,) comes from `ImuNoise`. Returns the nodes (N, 22) that stood before each
    step, the first at `t_s`.
    """
    nodes = np.empty((len(imu), NODE))
    _propagate(state.x, state.R, P, imu, densities, t_s, nodes)
    return nodes


@njit(cache=True, nogil=True)
def _propagate(x, R, P, imu, densities, t, nodes):  # type: ignore[no-untyped-def]
    half, dR, middle, A = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    T = np.empty((18, 18))
    for k in range(imu.shape[0]):
        dt = imu[k, 0]
        w0, w1, w2 = imu[k, 1] - x[15], imu[k, 2] - x[16], imu[k, 3] - x[17]
        f0, f1, f2 = imu[k, 4] - x[18], imu[k, 5] - x[19], imu[k, 6] - x[20]
        nodes[k, 0] = t
        for i in range(15):
            nodes[k, 1 + i] = x[i]
        nodes[k, 16], nodes[k, 17], nodes[k, 18] = w0, w1, w2
        exp_into(0.5 * w0 * dt, 0.5 * w1 * dt, 0.5 * w2 * dt, half)
        multiply_into(half, half, dR)
        multiply_into(R, half, middle)  # the force is a mean: it belongs to the attitude halfway
        h0 = half[0, 0] * f0 + half[0, 1] * f1 + half[0, 2] * f2
        h1 = half[1, 0] * f0 + half[1, 1] * f1 + half[1, 2] * f2
        h2 = half[2, 0] * f0 + half[2, 1] * f1 + half[2, 2] * f2
        for i in range(3):
            r0, r1, r2 = R[i, 0], R[i, 1], R[i, 2]
            nodes[k, 19 + i] = r0 * h0 + r1 * h1 + r2 * h2 + x[21 + i]
            A[i, 0], A[i, 1], A[i, 2] = r2 * h1 - r1 * h2, r0 * h2 - r2 * h0, r1 * h0 - r0 * h1  # -R [h]x
        _transition(P, T, dR, A, middle, dt)
        for i in range(3):
            P[i, i] += densities[0] * dt
            P[6 + i, 6 + i] += densities[1] * dt
            P[9 + i, 9 + i] += densities[2] * dt
            P[12 + i, 12 + i] += densities[3] * dt
            a = nodes[k, 19 + i]
            x[9 + i] += x[12 + i] * dt + 0.5 * a * dt * dt
            x[12 + i] += a * dt
        multiply_into(middle, half, dR)
        for i in range(9):  # R lies in x; an assignment of slices would take seconds to compile
            x[i] = dR[i // 3, i % 3]
        t += dt


@njit(cache=True, nogil=True)
def _transition(P, T, dR, A, R, dt):  # type: ignore[no-untyped-def]
    """P = F P F', F = I + its non-zero blocks; A = dv/dtheta / dt, -R = dv/dba / dt."""
    h = 0.5 * dt
    for c in range(18):  # T = F P
        for i in range(3):
            dv = A[i, 0] * (P[0, c] - h * P[9, c]) + A[i, 1] * (P[1, c] - h * P[10, c])
            dv += A[i, 2] * (P[2, c] - h * P[11, c]) + P[15 + i, c]
            dv -= R[i, 0] * P[12, c] + R[i, 1] * P[13, c] + R[i, 2] * P[14, c]
            T[i, c] = dR[0, i] * P[0, c] + dR[1, i] * P[1, c] + dR[2, i] * P[2, c] - dt * P[9 + i, c]
            T[3 + i, c] = P[3 + i, c] + dt * (P[6 + i, c] + h * dv)
            T[6 + i, c] = P[6 + i, c] + dt * dv
        for i in range(9, 18):
            T[i, c] = P[i, c]
    for r in range(18):  # P = T F'
        for i in range(3):
            dv = A[i, 0] * (T[r, 0] - h * T[r, 9]) + A[i, 1] * (T[r, 1] - h * T[r, 10])
            dv += A[i, 2] * (T[r, 2] - h * T[r, 11]) + T[r, 15 + i]
            dv -= R[i, 0] * T[r, 12] + R[i, 1] * T[r, 13] + R[i, 2] * T[r, 14]
            P[r, i] = dR[0, i] * T[r, 0] + dR[1, i] * T[r, 1] + dR[2, i] * T[r, 2] - dt * T[r, 9 + i]
            P[r, 3 + i] = T[r, 3 + i] + dt * (T[r, 6 + i] + h * dv)
            P[r, 6 + i] = T[r, 6 + i] + dt * dv
        for i in range(9, 18):
            P[r, i] = T[r, i]
