"""The last 1.28 s of truth at the physics rate: poses, and integrals of what an IMU feels.

Row k % SIZE of the ring (SIZE, 13): p_world 0:3, q_world_body 3:7, integral of specific force
7:10 (body frame, m/s) and integral of angular rate 10:13 (rad) after physics step k. Rows before
the first step hold the aircraft at rest where it stands.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from companion.core.errors import InputError
from companion.core.messages import Array
from sim.vehicle.dynamics import STEP_NS, STEP_S
from sim.vehicle.params import GRAVITY_M_S2

SIZE = 1024


def new_ring(x: Array) -> Array:
    """A ring in which the aircraft has always stood still at state x (17,)."""
    ring = np.zeros((SIZE, 13))
    ring[:, :3], ring[:, 3:7] = x[:3], x[6:10]
    w, a, b, c = x[6:10]
    up_body = np.array([2 * (a * c - w * b), 2 * (b * c + w * a), 1 - 2 * (a * a + b * b)])
    steps = np.arange(SIZE)
    steps[1:] -= SIZE  # row 0 is step 0, row k is step k - SIZE
    ring[:, 7:10] = steps[:, None] * STEP_S * GRAVITY_M_S2 * up_body
    return ring


def poses_at(ring: Array, steps_done: int, stamps_ns: NDArray[np.int64]) -> tuple[Array, Array]:
    """Poses (N, 3), (N, 4) at stamps (N,): linear in position, normalised linear in attitude."""
    stamps = np.ascontiguousarray(stamps_ns, dtype=np.int64)
    p, q = np.empty((len(stamps), 3)), np.empty((len(stamps), 4))
    if not _interpolate(ring, steps_done, stamps, p, q):
        raise _out_of_reach(steps_done, stamps)
    return p, q


def mean_since(ring: Array, steps_done: int, since_ns: int) -> tuple[Array, Array]:
    """Mean specific force (3,) m/s2 and mean angular rate (3,) rad/s, body frame, since a time."""
    out = np.empty(6)
    if not _mean(ring, steps_done, since_ns, out):
        raise _out_of_reach(steps_done, np.array([since_ns]))
    return out[:3], out[3:]


def _out_of_reach(steps_done: int, stamps: NDArray[np.int64]) -> InputError:
    now = steps_done * STEP_NS
    return InputError(
        f"{stamps.min()} .. {stamps.max()} ns is not in the history",
        field="stamps_ns",
        valid=f"{now - (SIZE - 1) * STEP_NS} .. {now}",
    )


@njit(cache=True, nogil=True)
def _interpolate(ring, steps_done, stamps, p, q):  # type: ignore[no-untyped-def]
    for n in range(stamps.shape[0]):
        k = stamps[n] // STEP_NS
        part = (stamps[n] - k * STEP_NS) / STEP_NS
        if k <= steps_done - SIZE or stamps[n] > steps_done * STEP_NS:
            return False
        a = ring[k % SIZE]
        b = ring[(k + 1) % SIZE] if part > 0.0 else a
        norm = 0.0
        for i in range(3):
            p[n, i] = a[i] + part * (b[i] - a[i])
        for i in range(4):
            q[n, i] = a[3 + i] + part * (b[3 + i] - a[3 + i])
            norm += q[n, i] * q[n, i]
        norm = math.sqrt(norm)
        for i in range(4):
            q[n, i] /= norm
    return True


@njit(cache=True, nogil=True)
def _mean(ring, steps_done, since_ns, out):  # type: ignore[no-untyped-def]
    k = since_ns // STEP_NS
    part = (since_ns - k * STEP_NS) / STEP_NS
    span = steps_done * STEP_NS - since_ns
    if k <= steps_done - SIZE or span <= 0:
        return False
    a, b, now = ring[k % SIZE], ring[(k + 1) % SIZE], ring[steps_done % SIZE]
    for i in range(6):
        out[i] = (now[7 + i] - (a[7 + i] + part * (b[7 + i] - a[7 + i]))) / (span * 1e-9)
    return True


@njit(cache=True, nogil=True)
def _record(ring, step, before, x, moved_by):  # type: ignore[no-untyped-def]
    """Append state x after step number `step`; `before` is the state a step of `moved_by` s earlier.

    The specific force is the step's change of velocity without gravity, seen from the attitude
    in the middle; the rate is the rotation between the attitudes: both agree with the motion
    itself, so that an integrator without noise returns to it.
    """
    last, row = ring[(step - 1) % SIZE], ring[step % SIZE]
    for i in range(7):
        row[i] = x[i] if i < 3 else x[3 + i]
    aw, ax, ay, az = before[6], before[7], before[8], before[9]
    bw, bx, by, bz = x[6], x[7], x[8], x[9]
    w = aw * bw + ax * bx + ay * by + az * bz
    rx = aw * bx - ax * bw - ay * bz + az * by
    ry = aw * by - ay * bw - az * bx + ax * bz
    rz = aw * bz - az * bw - ax * by + ay * bx
    sine = math.sqrt(rx * rx + ry * ry + rz * rz)
    scale = 2.0 * math.atan2(sine, w) / sine if sine > 1e-12 else 2.0
    row[10] = last[10] + scale * rx
    row[11] = last[11] + scale * ry
    row[12] = last[12] + scale * rz
    qw, qx, qy, qz = aw + bw, ax + bx, ay + by, az + bz
    n = 2.0 / (qw * qw + qx * qx + qy * qy + qz * qz)
    fx, fy, fz = x[3] - before[3], x[4] - before[4], x[5] - before[5] + GRAVITY_M_S2 * moved_by
    row[7] = last[7] + fx - n * ((qy * qy + qz * qz) * fx - (qx * qy + qw * qz) * fy - (qx * qz - qw * qy) * fz)
    row[8] = last[8] + fy - n * ((qx * qx + qz * qz) * fy - (qx * qy - qw * qz) * fx - (qy * qz + qw * qx) * fz)
    row[9] = last[9] + fz - n * ((qx * qx + qy * qy) * fz - (qx * qz + qw * qy) * fx - (qy * qz - qw * qx) * fy)
