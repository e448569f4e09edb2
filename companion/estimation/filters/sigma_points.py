"""Sigma points on the manifold of the packed state: spread, moved by the IMU, averaged.

Points are spread in the error state around a mean, and their errors about a mean are what
is averaged, so attitudes are never added. Source: C. Hertzberg et al., "Integrating Generic
Sensor Fusion Algorithms with Sound State Representations", Information Fusion 2013; the set
without centre point after I. Arasaratnam and S. Haykin, "Cubature Kalman Filters", TAC 2009
(S. Julier's unscented set with kappa = 0).
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from companion.core.messages import Array
from companion.estimation.so3 import exp_into, multiply_into
from companion.estimation.state import ERROR, STATE, State

POINTS = 2 * ERROR  # of equal weight


def spread(state: State, P: Array) -> Array:
    """Points (36, 24) whose errors about `state` have mean zero and covariance P (18, 18).

    Raises numpy.linalg.LinAlgError if P is not positive definite.
    """
    offsets = math.sqrt(ERROR) * np.linalg.cholesky(P).T
    points = np.empty((POINTS, STATE))
    _retract_each(state.x, np.concatenate([offsets, -offsets]), points)
    return points


def errors_about(points: Array, state: State) -> Array:
    """Error states (N, 18) that lead from `state` to each of the points (N, 24)."""
    errors = np.empty((len(points), ERROR))
    _minus_each(points, state.x, errors)
    return errors


def move_to_mean(points: Array, state: State, *, iterations: int = 3) -> Array:
    """Put `state` at the points' mean, in place; returns their errors about it, (N, 18)."""
    for _ in range(iterations):
        state.retract(errors_about(points, state).mean(axis=0))
    return errors_about(points, state)


@njit(cache=True, nogil=True)
def propagate_points(points: Array, imu: Array) -> None:
    """Run IMU pieces (N, 7) through every point, in place: the mean of `propagation.propagate`."""
    half, turn, middle, R = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    for n in range(points.shape[0]):
        x = points[n]
        for i in range(9):
            R[i // 3, i % 3] = x[i]
        for k in range(imu.shape[0]):
            dt = imu[k, 0]
            h = 0.5 * dt
            exp_into(h * (imu[k, 1] - x[15]), h * (imu[k, 2] - x[16]), h * (imu[k, 3] - x[17]), half)
            multiply_into(R, half, middle)
            multiply_into(half, half, turn)
            f0, f1, f2 = imu[k, 4] - x[18], imu[k, 5] - x[19], imu[k, 6] - x[20]
            h0 = half[0, 0] * f0 + half[0, 1] * f1 + half[0, 2] * f2
            h1 = half[1, 0] * f0 + half[1, 1] * f1 + half[1, 2] * f2
            h2 = half[2, 0] * f0 + half[2, 1] * f1 + half[2, 2] * f2
            for i in range(3):
                a = R[i, 0] * h0 + R[i, 1] * h1 + R[i, 2] * h2 + x[21 + i]
                x[9 + i] += x[12 + i] * dt + 0.5 * a * dt * dt
                x[12 + i] += a * dt
            multiply_into(middle, half, R)
        for i in range(9):
            x[i] = R[i // 3, i % 3]


@njit(cache=True, nogil=True)
def _retract_each(x, errors, points):  # type: ignore[no-untyped-def]
    turn, R, turned = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    for i in range(9):
        R[i // 3, i % 3] = x[i]
    for n in range(errors.shape[0]):
        exp_into(errors[n, 0], errors[n, 1], errors[n, 2], turn)
        multiply_into(R, turn, turned)
        for i in range(9):
            points[n, i] = turned[i // 3, i % 3]
        for i in range(15):
            points[n, 9 + i] = x[9 + i] + errors[n, 3 + i]


@njit(cache=True, nogil=True)
def _minus_each(points, x, errors):  # type: ignore[no-untyped-def]
    """The rotation vector by its sine and cosine: points lie well within a half turn of the mean."""
    D = np.empty((3, 3))
    for n in range(points.shape[0]):
        for i in range(3):
            for j in range(3):
                D[i, j] = x[i] * points[n, j] + x[3 + i] * points[n, 3 + j] + x[6 + i] * points[n, 6 + j]
        s0, s1, s2 = 0.5 * (D[2, 1] - D[1, 2]), 0.5 * (D[0, 2] - D[2, 0]), 0.5 * (D[1, 0] - D[0, 1])
        sine = math.sqrt(s0 * s0 + s1 * s1 + s2 * s2)
        angle = math.atan2(sine, 0.5 * (D[0, 0] + D[1, 1] + D[2, 2] - 1.0))
        scale = angle / sine if sine > 1e-9 else 1.0
        errors[n, 0], errors[n, 1], errors[n, 2] = scale * s0, scale * s1, scale * s2
        for i in range(15):
            errors[n, 3 + i] = points[n, 9 + i] - x[9 + i]
