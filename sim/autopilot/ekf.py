"""The kernels of the autopilot's estimator: an error-state Kalman filter in NED/FRD.

State x (16,): q_ned_frd (wxyz) 0:4, v_ned 4:7, p_ned 7:10, gyro bias 10:13, accel bias 13:16.
Error (15,): theta_ned (q_true = exp(theta) * q), v, p, gyro bias, accel bias. With the
attitude error in the world frame a heading correction turns every old attitude alike, so
the ring of past states that delayed measurements are compared with is corrected in one go.
Source: J. Sola, "Quaternion kinematics for the error-state Kalman filter", 2017, ch. 7.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

GRAVITY = 9.80665
RING = 256  # past states, one per IMU sample: 0.64 s at 400 Hz
PAST = 10  # q, v, p of a past state
ROWS = 7  # of an external pose: p_ned, v_ned, yaw

# Places in `work`: what the kernels carry from sample to sample.
SUM_DT, SUM_F, LP_ACC, OMEGA, FORCE, SHAKE = 0, 1, 4, 7, 10, 13
WORK = 16


@njit(cache=True, nogil=True)
def imu_step(x, P, ring, work, at, gyro, accel, noise):  # type: ignore[no-untyped-def]
    """Advance by one IMU sample (FLU, means over noise[0] s) and write the new state to ring[at].

    `noise`: dt, period of the covariance, low-pass gain of the acceleration, then the
    standard deviations of gyro, accel, gyro bias walk and accel bias walk.
    """
    dt = noise[0]
    wx, wy, wz = gyro[0] - x[10], -gyro[1] - x[11], -gyro[2] - x[12]
    fx, fy, fz = accel[0] - x[13], -accel[1] - x[14], -accel[2] - x[15]
    work[OMEGA], work[OMEGA + 1], work[OMEGA + 2] = wx, wy, wz
    for i, f in enumerate((fx, fy, fz)):
        work[SHAKE + i] += 0.01 * (abs(f - work[FORCE + i]) - work[SHAKE + i])
        work[FORCE + i] = f
    _turn(x, 0.5 * dt * wx, 0.5 * dt * wy, 0.5 * dt * wz)  # attitude at mid-interval
    R = rotation_of(x)
    _turn(x, 0.5 * dt * wx, 0.5 * dt * wy, 0.5 * dt * wz)
    for i in range(3):
        f = R[i, 0] * fx + R[i, 1] * fy + R[i, 2] * fz
        a = f + (GRAVITY if i == 2 else 0.0)
        x[7 + i] += dt * (x[4 + i] + 0.5 * dt * a)
        x[4 + i] += dt * a
        work[SUM_F + i] += f * dt
        work[LP_ACC + i] += noise[2] * (a - work[LP_ACC + i])
    work[SUM_DT] += dt
    if work[SUM_DT] >= noise[1] - 1e-9:
        _grow_covariance(P, R, work, noise)
    for i in range(PAST):
        ring[at, i] = x[i]


@njit(cache=True, nogil=True)
def _turn(x, rx, ry, rz):  # type: ignore[no-untyped-def]
    """q <- q * exp(r), r small and in the body frame; renormalised."""
    angle2 = rx * rx + ry * ry + rz * rz
    s, c = 0.5 - angle2 / 48.0, 1.0 - angle2 / 8.0
    w, a, b, d = x[0], x[1], x[2], x[3]
    u, v, t = s * rx, s * ry, s * rz
    x[0] = w * c - a * u - b * v - d * t
    x[1] = w * u + a * c + b * t - d * v
    x[2] = w * v - a * t + b * c + d * u
    x[3] = w * t + a * v - b * u + d * c
    n = 1.0 / math.sqrt(x[0] * x[0] + x[1] * x[1] + x[2] * x[2] + x[3] * x[3])
    for i in range(4):
        x[i] *= n


@njit(cache=True, nogil=True)
def _turn_world(q, r):  # type: ignore[no-untyped-def]
    """q <- exp(r) * q, r in the world frame, of any size."""
    angle = math.sqrt(r[0] * r[0] + r[1] * r[1] + r[2] * r[2])
    s = 0.5 if angle < 1e-9 else math.sin(0.5 * angle) / angle
    c, u, v, t = math.cos(0.5 * angle), s * r[0], s * r[1], s * r[2]
    w, a, b, d = q[0], q[1], q[2], q[3]
    q[0] = c * w - u * a - v * b - t * d
    q[1] = c * a + u * w + v * d - t * b
    q[2] = c * b - u * d + v * w + t * a
    q[3] = c * d + u * b - v * a + t * w


@njit(cache=True, nogil=True)
def rotation_of(q):  # type: ignore[no-untyped-def]
    """R_ned_frd of a quaternion wxyz."""
    w, x, y, z = q[0], q[1], q[2], q[3]
    R = np.empty((3, 3))
    R[0, 0], R[0, 1], R[0, 2] = 1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)
    R[1, 0], R[1, 1], R[1, 2] = 2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)
    R[2, 0], R[2, 1], R[2, 2] = 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)
    return R


@njit(cache=True, nogil=True)
def _grow_covariance(P, R, work, noise):  # type: ignore[no-untyped-def]
    """P <- F P F' + Q over the time since the last call, with the mean specific force."""
    dt = work[SUM_DT]
    sx, sy, sz = work[SUM_F], work[SUM_F + 1], work[SUM_F + 2]
    for j in range(15):  # P <- F P; p first, for it needs the old v
        t0, t1, t2 = P[0, j], P[1, j], P[2, j]
        for i in range(3):
            P[6 + i, j] += dt * P[3 + i, j]
            for k in range(3):
                P[i, j] -= dt * R[i, k] * P[9 + k, j]
                P[3 + i, j] -= dt * R[i, k] * P[12 + k, j]
        P[3, j] -= sy * t2 - sz * t1
        P[4, j] -= sz * t0 - sx * t2
        P[5, j] -= sx * t1 - sy * t0
    for j in range(15):  # P <- P F'
        t0, t1, t2 = P[j, 0], P[j, 1], P[j, 2]
        for i in range(3):
            P[j, 6 + i] += dt * P[j, 3 + i]
            for k in range(3):
                P[j, i] -= dt * R[i, k] * P[j, 9 + k]
                P[j, 3 + i] -= dt * R[i, k] * P[j, 12 + k]
        P[j, 3] -= sy * t2 - sz * t1
        P[j, 4] -= sz * t0 - sx * t2
        P[j, 5] -= sx * t1 - sy * t0
    for i in range(3):
        P[i, i] += (noise[3] * dt) ** 2
        P[3 + i, 3 + i] += (noise[4] * dt) ** 2
        P[9 + i, 9 + i] += (noise[5] * dt) ** 2
        P[12 + i, 12 + i] += (noise[6] * dt) ** 2
    for i in range(SUM_DT, SUM_F + 3):
        work[i] = 0.0


@njit(cache=True, nogil=True)
def past_state(ring, stamps, stamp_ns, out):  # type: ignore[no-untyped-def]
    """State at `stamp_ns` into `out` (10,); returns how far outside the ring that is, ns."""
    best, oldest, newest = -1, 0, 0
    for k in range(RING):
        if stamps[k] < stamps[oldest]:
            oldest = k
        if stamps[k] > stamps[newest]:
            newest = k
        if stamps[k] <= stamp_ns and (best < 0 or stamps[k] > stamps[best]):
            best = k
    best = max(best, 0) if best >= 0 else oldest
    ahead = min(max((stamp_ns - stamps[best]) * 1e-9, 0.0), 0.02)
    for i in range(PAST):
        out[i] = ring[best, i] + (ahead * ring[best, i - 3] if i >= 7 else 0.0)
    if stamp_ns < stamps[oldest]:
        return stamps[oldest] - stamp_ns
    return max(0, stamp_ns - stamps[newest] - 20_000_000)


@njit(cache=True, nogil=True)
def _fuse_row(x, P, past, h, innovation, variance, gate, total):  # type: ignore[no-untyped-def]
    """One scalar measurement; returns innovation^2 / (gate^2 S): it is used below 1 (gate 0: always)."""
    Ph = np.zeros(15)
    for i in range(15):
        for k in range(15):
            Ph[i] += P[i, k] * h[k]
    S = variance
    for k in range(15):
        S += h[k] * Ph[k]
    ratio = innovation * innovation / (gate * gate * S) if gate > 0.0 else 0.0
    if not ratio < 1.0:
        return ratio
    dx = np.empty(15)
    for i in range(15):
        dx[i] = Ph[i] * innovation / S
        total[i] += dx[i]
        for k in range(15):
            P[i, k] -= Ph[i] * Ph[k] / S
        P[i, i] = max(P[i, i], 1e-12)
    _turn_world(x, dx)
    for i in range(12):
        x[4 + i] += dx[3 + i]
    _turn_world(past, dx)
    for i in range(6):
        past[4 + i] += dx[3 + i]
    return ratio


@njit(cache=True, nogil=True)
def _correct_ring(ring, total):  # type: ignore[no-untyped-def]
    for k in range(RING):
        _turn_world(ring[k], total)
        for i in range(6):
            ring[k, 4 + i] += total[3 + i]


@njit(cache=True, nogil=True)
def yaw_of(q):  # type: ignore[no-untyped-def]
    """Heading from north, clockwise, rad."""
    w, x, y, z = q[0], q[1], q[2], q[3]
    return math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))


@njit(cache=True, nogil=True)
def _yaw_row(q, h):  # type: ignore[no-untyped-def]
    """d yaw / d theta_ned = (cos(yaw) tan(pitch), sin(yaw) tan(pitch), 1)."""
    sine = min(0.98, max(-0.98, 2 * (q[0] * q[2] - q[3] * q[1])))
    tangent = sine / math.sqrt(1 - sine * sine)
    yaw = yaw_of(q)
    h[0], h[1], h[2] = math.cos(yaw) * tangent, math.sin(yaw) * tangent, 1.0


@njit(cache=True, nogil=True)
def fuse_pose(x, P, ring, past, z, variance, gates, ratios):  # type: ignore[no-untyped-def]
    """Fuse an external pose z (7,): p_ned, v_ned, yaw; NaN rows are absent.

    `past` is the state at its stamp; `ratios` receives each row's innovation test.
    """
    total = np.zeros(15)
    for row in range(ROWS):
        ratios[row] = math.nan
        if not math.isfinite(z[row]):
            continue
        h = np.zeros(15)
        if row < 3:
            h[6 + row] = 1.0
            innovation = z[row] - past[7 + row]
        elif row < 6:
            h[row] = 1.0
            innovation = z[row] - past[1 + row]
        else:
            _yaw_row(past, h)
            innovation = z[6] - yaw_of(past)
            innovation -= 2 * math.pi * round(innovation / (2 * math.pi))
        ratios[row] = _fuse_row(x, P, past, h, innovation, variance[row], gates[row], total)
    _correct_ring(ring, total)


@njit(cache=True, nogil=True)
def fuse_gravity(x, P, ring, force, sigma):  # type: ignore[no-untyped-def]
    """The specific force points up on average: holds roll and pitch while nothing else does."""
    total, unused = np.zeros(15), np.zeros(PAST)
    R = rotation_of(x)
    for row in range(2):
        h = np.zeros(15)
        h[1 - row] = -GRAVITY if row == 0 else GRAVITY  # d(R f) = theta x (0, 0, -g)
        level = R[row, 0] * force[0] + R[row, 1] * force[1] + R[row, 2] * force[2]
        _fuse_row(x, P, unused, h, -level, sigma * sigma, 0.0, total)
    _correct_ring(ring, total)


@njit(cache=True, nogil=True)
def reset_row(x, P, ring, past, row, value, variance):  # type: ignore[no-untyped-def]
    """Move one row (as in `_fuse_pose`) to a measured value, now and in the past; forget its correlations."""
    if row < 6:
        k, error = (7 + row, 6 + row) if row < 3 else (1 + row, row)
        step = value - past[k]
        x[k] += step
        past[k] += step
        for i in range(RING):
            ring[i, k] += step
    else:
        error = 2
        turn = np.zeros(3)
        turn[2] = value - yaw_of(past)
        _turn_world(x, turn)
        _turn_world(past, turn)
        for i in range(RING):
            _turn_world(ring[i], turn)
    for i in range(15):
        P[error, i] = 0.0
        P[i, error] = 0.0
    P[error, error] = variance
