"""SO(3) for kernels: the same formulas as `companion.core.geometry`, without allocation."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from companion.core.messages import Array


@njit(cache=True, nogil=True)
def exp_into(x: float, y: float, z: float, R: Array) -> None:
    """Rotation vector (x, y, z), rad -> R (3, 3), written in place (Rodrigues)."""
    angle2 = x * x + y * y + z * z
    if angle2 < 0.01:  # the next terms are below 2e-10
        a = 1.0 - angle2 / 6.0 * (1.0 - angle2 / 20.0)
        b = 0.5 - angle2 / 24.0 * (1.0 - angle2 / 30.0)
    else:
        angle = math.sqrt(angle2)
        a = math.sin(angle) / angle
        b = (1.0 - math.cos(angle)) / angle2
    R[0, 0] = 1.0 - b * (y * y + z * z)
    R[1, 1] = 1.0 - b * (x * x + z * z)
    R[2, 2] = 1.0 - b * (x * x + y * y)
    R[0, 1] = b * x * y - a * z
    R[1, 0] = b * x * y + a * z
    R[0, 2] = b * x * z + a * y
    R[2, 0] = b * x * z - a * y
    R[1, 2] = b * y * z - a * x
    R[2, 1] = b * y * z + a * x


@njit(cache=True, nogil=True)
def multiply_into(A: Array, B: Array, C: Array) -> None:
    """C = A @ B for (3, 3); C must be another array."""
    for i in range(3):
        for j in range(3):
            C[i, j] = A[i, 0] * B[0, j] + A[i, 1] * B[1, j] + A[i, 2] * B[2, j]


def orthonormal(R: Array) -> Array:
    """The rotation nearest to R (3, 3): one Newton step of the polar decomposition.

    Products of rotations leave SO(3) by rounding only, so one step is enough.
    """
    return R @ (1.5 * np.eye(3) - 0.5 * R.T @ R)


def tilt_free(up: Array) -> Array:
    """The smallest rotation that turns the vector `up` (3,) onto +z, (3, 3)."""
    x, y, z = up / np.linalg.norm(up)
    if z < -0.999999:
        return np.diag([1.0, -1.0, -1.0])
    k = 1.0 / (1.0 + z)
    return np.array([[1.0 - k * x * x, -k * x * y, -x], [-k * x * y, 1.0 - k * y * y, -y], [x, y, z]])
