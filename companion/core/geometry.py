"""SO(3) on arrays: quaternions are wxyz, Hamilton, unit; q_a_b rotates b-vectors into a.

Source: J. Sola, "Quaternion kinematics for the error-state Kalman filter", 2017.
"""

from __future__ import annotations

import math

import numpy as np

from companion.core.messages import Array

IDENTITY_Q: Array = np.array([1.0, 0.0, 0.0, 0.0])
IDENTITY_Q.flags.writeable = False


def skew(v: Array) -> Array:
    """(3,) -> (3, 3) with skew(v) @ w == cross(v, w)."""
    x, y, z = v
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def quaternion_multiply(a: Array, b: Array) -> Array:
    """Hamilton product: q_a_c = q_a_b * q_b_c."""
    aw, ax, ay, az = a
    bw, bx, by, bz = b
    return np.array(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ]
    )


def quaternion_conjugate(q: Array) -> Array:
    """Inverse of a unit quaternion."""
    w, x, y, z = q
    return np.array([w, -x, -y, -z])


def rotation_from_quaternion(q: Array) -> Array:
    """wxyz (4,) -> rotation matrix (3, 3)."""
    w, x, y, z = q
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def quaternion_from_rotation(R: Array) -> Array:
    """Rotation matrix (3, 3) -> wxyz (4,), w >= 0. Shepperd's method."""
    diagonal = (R[0, 0] + R[1, 1] + R[2, 2], R[0, 0], R[1, 1], R[2, 2])
    k = int(np.argmax(diagonal))
    if k == 0:
        q = np.array([1 + diagonal[0], R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
    else:
        i, j, l = k - 1, k % 3, (k + 1) % 3  # noqa: E741 (cyclic axes)
        q = np.empty(4)
        q[0] = R[l, j] - R[j, l]
        q[1 + i] = 1 + R[i, i] - R[j, j] - R[l, l]
        q[1 + j] = R[j, i] + R[i, j]
        q[1 + l] = R[l, i] + R[i, l]
    unit: Array = q / np.linalg.norm(q)
    return unit if unit[0] >= 0 else -unit


def exp_so3(theta: Array) -> Array:
    """Rotation vector (3,) -> rotation matrix (Rodrigues)."""
    angle2 = float(theta @ theta)
    K = skew(theta)
    if angle2 < 1e-12:
        return np.eye(3) + K + 0.5 * K @ K
    angle = math.sqrt(angle2)
    return np.eye(3) + math.sin(angle) / angle * K + (1 - math.cos(angle)) / angle2 * K @ K


def log_so3(R: Array) -> Array:
    """Rotation matrix -> rotation vector, |theta| <= pi."""
    q = quaternion_from_rotation(R)
    sine = float(np.linalg.norm(q[1:]))
    if sine < 1e-9:
        return 2.0 * q[1:]
    return 2.0 * math.atan2(sine, q[0]) / sine * q[1:]


def rotate(q: Array, v: Array) -> Array:
    """Rotate vectors (..., 3) by the unit quaternion q."""
    rotated: Array = np.asarray(v) @ rotation_from_quaternion(q).T
    return rotated


def yaw_of(q: Array) -> float:
    """Heading about +z from +x, rad, in (-pi, pi]."""
    w, x, y, z = q
    return math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))


def quaternion_from_yaw(yaw: float) -> Array:
    """Level attitude with the given heading."""
    return np.array([math.cos(yaw / 2), 0.0, 0.0, math.sin(yaw / 2)])


def wrap_angle(angle: float) -> float:
    """To (-pi, pi]."""
    return -math.remainder(-angle, 2 * math.pi)
