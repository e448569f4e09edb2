"""Bring every point of a sweep into the body frame of the sweep's end, by its own time."""

from __future__ import annotations

from typing import Annotated

import msgspec
import numpy as np
from numba import njit

from companion.core.messages import Array, Array32
from companion.estimation.propagation import NODE
from companion.estimation.so3 import exp_into, multiply_into


class ScanGate(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Which returns are taken at all; NaN and infinite points never are."""

    min_range_m: Annotated[float, msgspec.Meta(ge=0)] = 0.4
    max_range_m: Annotated[float, msgspec.Meta(gt=0)] = 80.0
    hull_half_m: tuple[float, float, float] = (0.35, 0.35, 0.2)  # own body, box around its origin
    max_age_s: Annotated[float, msgspec.Meta(gt=0)] = 0.25  # older points are dropped


def deskew_points(
    points_sensor: Array32,
    age_s: Array32,
    nodes: Array,
    *,
    pose_end: tuple[Array, Array],
    t_end_s: float,
    mount: tuple[Array, Array],
    gate: ScanGate,
) -> Array32:
    """(N, 3) in the sensor frame of each point's time -> (M, 3) in the body frame at `t_end_s`.

    `nodes` (K, 22) is the log of `propagate`; `pose_end` = (R_odom_body, p_odom) at the end;
    `mount` = (R_body_sensor, p_body). Points that fail `gate` are left out.
    """
    out = np.empty((len(points_sensor), 3), np.float32)
    points_sensor, age_s = read_only(points_sensor), read_only(age_s)
    limits = np.array([gate.min_range_m, gate.max_range_m, *gate.hull_half_m, gate.max_age_s])
    count = _deskew(points_sensor, age_s, nodes, t_end_s, *pose_end, *mount, limits, out)
    return out[:count]


def deskew_directions(
    dirs_sensor: Array32, age_s: Array32, nodes: Array, *, R_end: Array, t_end_s: float, R_body_sensor: Array
) -> Array32:
    """Unit directions (N, 3), each of its own time -> body frame at the end, (N, 3)."""
    out = np.empty((len(dirs_sensor), 3), np.float32)
    dirs_sensor, age_s = read_only(dirs_sensor), read_only(age_s)
    _turn(dirs_sensor, age_s, nodes, t_end_s, R_end, R_body_sensor, out)
    return out


def read_only(values: Array32) -> Array32:
    """A contiguous read-only view, so that kernels compile for one type only."""
    view = np.ascontiguousarray(values, np.float32).view()
    view.flags.writeable = False
    return view


def constant_twist_nodes(
    R: Array, p: Array, omega_body: Array, v_body: Array, *, t_end_s: float, duration_s: float
) -> Array:
    """Nodes of a motion with constant body twist that ends in (R, p) at `t_end_s`, (9, 22)."""
    nodes = np.zeros((9, NODE))
    E = np.empty((3, 3))
    turned = R.copy()
    at = p.copy()
    step = duration_s / len(nodes)
    x, y, z = -omega_body * step / 2
    for k in range(len(nodes) - 1, -1, -1):
        exp_into(x, y, z, E)
        middle = turned @ E
        turned = middle @ E
        at = at - middle @ v_body * step
        nodes[k, 0] = t_end_s - duration_s + k * step
        nodes[k, 1:10] = turned.ravel()
        nodes[k, 10:13], nodes[k, 13:16] = at, turned @ v_body
        nodes[k, 16:19], nodes[k, 19:22] = omega_body, turned @ np.cross(omega_body, v_body)
    return nodes


def move_nodes(nodes: Array, before: tuple[Array, Array, Array], after: tuple[Array, Array, Array]) -> None:
    """Carry logged nodes along, in place, when a measurement corrects the newest pose.

    `before` and `after` = (R, p, v). Without this a sweep that straddles a camera update
    would be torn at it.
    """
    turn = after[0] @ before[0].T
    rotations = nodes[:, 1:10].reshape(-1, 3, 3)
    nodes[:, 1:10] = (turn @ rotations).reshape(-1, 9)
    nodes[:, 10:13] = (nodes[:, 10:13] - before[1]) @ turn.T + after[1]
    nodes[:, 13:16] = (nodes[:, 13:16] - before[2]) @ turn.T + after[2]
    nodes[:, 19:22] = nodes[:, 19:22] @ turn.T


@njit(cache=True, nogil=True)
def _deskew(points, ages, nodes, t_end, R1, p1, RBL, pBL, limits, out):  # type: ignore[no-untyped-def]
    count = 0
    k = np.int64(0)
    Rk = np.empty((3, 3))
    for q in range(points.shape[0]):
        a, b, c = np.float64(points[q, 0]), np.float64(points[q, 1]), np.float64(points[q, 2])
        age = np.float64(ages[q])
        square = a * a + b * b + c * c
        if not (limits[0] ** 2 <= square <= limits[1] ** 2 and 0.0 <= age <= limits[5]):
            continue  # also if anything is NaN
        x = RBL[0, 0] * a + RBL[0, 1] * b + RBL[0, 2] * c + pBL[0]
        y = RBL[1, 0] * a + RBL[1, 1] * b + RBL[1, 2] * c + pBL[1]
        z = RBL[2, 0] * a + RBL[2, 1] * b + RBL[2, 2] * c + pBL[2]
        if abs(x) < limits[2] and abs(y) < limits[3] and abs(z) < limits[4]:
            continue
        k, dt = _rotation_at(nodes, t_end - age, k, Rk)
        h = 0.5 * dt * dt
        d0 = nodes[k, 10] + nodes[k, 13] * dt + nodes[k, 19] * h - p1[0]
        d1 = nodes[k, 11] + nodes[k, 14] * dt + nodes[k, 20] * h - p1[1]
        d2 = nodes[k, 12] + nodes[k, 15] * dt + nodes[k, 21] * h - p1[2]
        d0 += Rk[0, 0] * x + Rk[0, 1] * y + Rk[0, 2] * z
        d1 += Rk[1, 0] * x + Rk[1, 1] * y + Rk[1, 2] * z
        d2 += Rk[2, 0] * x + Rk[2, 1] * y + Rk[2, 2] * z
        for i in range(3):
            out[count, i] = R1[0, i] * d0 + R1[1, i] * d1 + R1[2, i] * d2
        count += 1
    return count


@njit(cache=True, nogil=True)
def _turn(dirs, ages, nodes, t_end, R1, RBL, out):  # type: ignore[no-untyped-def]
    k = np.int64(0)
    Rk, M, Q = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    R1T = np.ascontiguousarray(R1.T)
    for q in range(dirs.shape[0]):
        k, _ = _rotation_at(nodes, t_end - np.float64(ages[q]), k, Rk)
        multiply_into(R1T, Rk, M)
        multiply_into(M, RBL, Q)
        for i in range(3):
            out[q, i] = Q[i, 0] * dirs[q, 0] + Q[i, 1] * dirs[q, 1] + Q[i, 2] * dirs[q, 2]


@njit(cache=True, nogil=True)
def _rotation_at(nodes, t, k, R):  # type: ignore[no-untyped-def]
    """R_odom_body at time t into R; returns the node before t (found from a guess k) and t minus its time.

    Written out: this is the inner loop of deskewing.
    """
    while k > 0 and nodes[k, 0] > t:
        k -= 1
    while k < nodes.shape[0] - 1 and nodes[k + 1, 0] <= t:
        k += 1
    dt = t - nodes[k, 0]
    x, y, z = nodes[k, 16] * dt, nodes[k, 17] * dt, nodes[k, 18] * dt
    angle2 = x * x + y * y + z * z
    a = 1.0 - angle2 / 6.0 * (1.0 - angle2 / 20.0)  # steps are short: |angle| < 0.3
    b = 0.5 - angle2 / 24.0 * (1.0 - angle2 / 30.0)
    e00, e11, e22 = 1.0 - b * (y * y + z * z), 1.0 - b * (x * x + z * z), 1.0 - b * (x * x + y * y)
    e01, e10 = b * x * y - a * z, b * x * y + a * z
    e02, e20 = b * x * z + a * y, b * x * z - a * y
    e12, e21 = b * y * z - a * x, b * y * z + a * x
    for i in range(3):
        r0, r1, r2 = nodes[k, 1 + 3 * i], nodes[k, 2 + 3 * i], nodes[k, 3 + 3 * i]
        R[i, 0] = r0 * e00 + r1 * e10 + r2 * e20
        R[i, 1] = r0 * e01 + r1 * e11 + r2 * e21
        R[i, 2] = r0 * e02 + r1 * e12 + r2 * e22
    return k, dt
