"""Multirotor equations of motion: rigid body, four rotors with lag, aerodynamics, legs on the ground.

State x (17,): p_world 0:3 (m), v_world 3:6 (m/s), q_world_body 6:10 (wxyz), omega_body 10:13
(rad/s), rotor speeds 13:17 (rad/s, >= 0). World ENU, body FLU, origin at the centre of mass.

With H = J w + sum_i s_i J_r W_i e_z (s: turning sense, W: rotor speed), Newton and Euler give
    m v' = R f - m g e_z,      J w' = tau - w x H - sum_i s_i J_r W_i' e_z,
so that without aerodynamics energy and the world's angular momentum are kept. Per rotor, with
the hub's velocity through the air (u, v, w) in the body frame:
    T = (k W^2 - k_z W w + k_h (u^2 + v^2) min(1, W / W_hover)) * ground effect,
    H-force = -k_d W (u, v),   torque on the body = -s k_Q W^2 (Svacha, Loianno, Kumar 2017);
    ground effect = 1 / (1 - (r / 4 h)^2) (Cheeseman and Bennett 1955), h >= r / 2.
Not modelled: vortex ring state, blade flapping moments, wash of one rotor on another.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from companion.core.messages import Array
from sim.vehicle.gear import _leg_forces
from sim.vehicle.params import GRAVITY_M_S2

STEP_NS = 1_250_000
STEP_S = STEP_NS * 1e-9
STATE_SIZE = 17
NO_ANCHORS: Array = np.full((4, 2), np.nan)  # no leg stands on the ground
DEEP_GROUND: Array = np.full(5, -1e9)  # ground far below body (0) and legs (1:5)


def derivative(
    model: NDArray[np.void],
    x: Array,
    rotor_demand: Array,
    *,
    wind_world: Array,
    ground_z: Array = DEEP_GROUND,
    anchors: Array = NO_ANCHORS,
) -> Array:
    """x' (17,) under demanded rotor speeds (4,); ground_z (5,) under body and legs, anchors (4, 2)."""
    out = np.empty(STATE_SIZE)
    _derivative(model, x, rotor_demand, wind_world, ground_z, anchors, out)
    return out


def step(
    model: NDArray[np.void],
    x: Array,
    rotor_demand: Array,
    *,
    wind_world: Array,
    ground_z: Array = DEEP_GROUND,
    anchors: Array = NO_ANCHORS,
    dt_s: float = STEP_S,
) -> Array:
    """The state after one Runge-Kutta step of `dt_s`."""
    after = np.array(x, dtype=np.float64)
    _rk4(model, after, rotor_demand, wind_world, ground_z, anchors, dt_s, np.empty((5, STATE_SIZE)))
    return after


def battery_volts(model: NDArray[np.void], charge_fraction: float, power_w: float) -> float:
    """Terminal voltage under a load; V = (E + sqrt(E^2 - 4 R P)) / 2, at most half of E is lost."""
    return float(_volts(model, charge_fraction, power_w))


@njit(cache=True, nogil=True)
def _rk4(model, x, demand, wind, ground_z, anchors, dt, work):  # type: ignore[no-untyped-def]
    """In place; `work` is (5, 17)."""
    k1, k2, k3, k4, y = work[0], work[1], work[2], work[3], work[4]
    _derivative(model, x, demand, wind, ground_z, anchors, k1)
    for i in range(17):
        y[i] = x[i] + 0.5 * dt * k1[i]
    _derivative(model, y, demand, wind, ground_z, anchors, k2)
    for i in range(17):
        y[i] = x[i] + 0.5 * dt * k2[i]
    _derivative(model, y, demand, wind, ground_z, anchors, k3)
    for i in range(17):
        y[i] = x[i] + dt * k3[i]
    _derivative(model, y, demand, wind, ground_z, anchors, k4)
    for i in range(17):
        x[i] += dt / 6.0 * (k1[i] + 2.0 * k2[i] + 2.0 * k3[i] + k4[i])
    norm = math.sqrt(x[6] * x[6] + x[7] * x[7] + x[8] * x[8] + x[9] * x[9])
    for i in range(6, 10):
        x[i] /= norm


@njit(cache=True, nogil=True)
def _derivative(model, x, demand, wind, ground_z, anchors, out):  # type: ignore[no-untyped-def]
    m = model[0]
    R = _rotation(x)
    load = _aerodynamics(m, x, R, wind, ground_z[0])  # force and torque in the body frame
    if x[2] - ground_z[0] < 1.0:
        load += _leg_forces(m, x, R, ground_z, anchors)
    spin = spin_up = 0.0
    for i in range(4):
        lag = demand[i] - x[13 + i]
        out[13 + i] = lag / (m.tau_up if lag > 0.0 else m.tau_down)
        spin += m.turning[i] * m.J_rotor * x[13 + i]
        spin_up += m.turning[i] * m.J_rotor * out[13 + i]
    for i in range(3):
        out[i] = x[3 + i]
        out[3 + i] = (R[i, 0] * load[0] + R[i, 1] * load[1] + R[i, 2] * load[2]) / m.mass
    out[5] -= GRAVITY_M_S2
    qw, qx, qy, qz = x[6], x[7], x[8], x[9]
    wx, wy, wz = x[10], x[11], x[12]
    out[6] = 0.5 * (-qx * wx - qy * wy - qz * wz)
    out[7] = 0.5 * (qw * wx + qy * wz - qz * wy)
    out[8] = 0.5 * (qw * wy + qz * wx - qx * wz)
    out[9] = 0.5 * (qw * wz + qx * wy - qy * wx)
    J, J_inverse = m.J, m.J_inverse
    hx = J[0, 0] * wx + J[0, 1] * wy + J[0, 2] * wz
    hy = J[1, 0] * wx + J[1, 1] * wy + J[1, 2] * wz
    hz = J[2, 0] * wx + J[2, 1] * wy + J[2, 2] * wz + spin
    tx = load[3] - (wy * hz - wz * hy)
    ty = load[4] - (wz * hx - wx * hz)
    tz = load[5] - (wx * hy - wy * hx) - spin_up
    for i in range(3):
        out[10 + i] = J_inverse[i, 0] * tx + J_inverse[i, 1] * ty + J_inverse[i, 2] * tz


@njit(cache=True, nogil=True)
def _aerodynamics(m, x, R, wind, ground_z):  # type: ignore[no-untyped-def]
    """Force and torque (6,) of body drag and rotors in the body frame."""
    load = np.zeros(6)
    air = np.empty(3)  # velocity of the body through the air, body frame
    for i in range(3):
        air[i] = R[0, i] * (x[3] - wind[0]) + R[1, i] * (x[4] - wind[1]) + R[2, i] * (x[5] - wind[2])
    speed = math.sqrt(air[0] * air[0] + air[1] * air[1] + air[2] * air[2])
    for i in range(3):
        load[i] = -m.drag[i] * speed * air[i]
    wx, wy, wz = x[10], x[11], x[12]
    for i in range(4):
        W = x[13 + i]
        hub = m.hub[i]
        u = air[0] + wy * hub[2] - wz * hub[1]
        v = air[1] + wz * hub[0] - wx * hub[2]
        w = air[2] + wx * hub[1] - wy * hub[0]
        lift = m.k_lift * (u * u + v * v) * min(1.0, W / m.hover_speed)
        thrust = m.k_thrust * W * W - m.k_axial * W * w + lift
        rise = R[2, 0] * hub[0] + R[2, 1] * hub[1] + R[2, 2] * hub[2]
        thrust *= m.health[i] * _ground_effect(m.ground_radius, x[2] + rise - ground_z)
        fx, fy = -m.k_rotor_drag * W * u, -m.k_rotor_drag * W * v
        load[0] += fx
        load[1] += fy
        load[2] += thrust
        load[3] += hub[1] * thrust - hub[2] * fy
        load[4] += hub[2] * fx - hub[0] * thrust
        load[5] += hub[0] * fy - hub[1] * fx - m.turning[i] * m.k_torque * W * W
    return load


@njit(cache=True, nogil=True)
def _ground_effect(radius, height):  # type: ignore[no-untyped-def]
    if radius <= 0.0 or height > 8.0 * radius:
        return 1.0
    ratio = radius / (4.0 * max(height, 0.5 * radius))
    return 1.0 / (1.0 - ratio * ratio)


@njit(cache=True, nogil=True)
def _rotation(x):  # type: ignore[no-untyped-def]
    """R_world_body of the state's quaternion, normalised: the inner stages are off by O(dt^2)."""
    n = 2.0 / (x[6] * x[6] + x[7] * x[7] + x[8] * x[8] + x[9] * x[9])
    w, a, b, c = x[6], x[7], x[8], x[9]
    R = np.empty((3, 3))
    R[0, 0], R[0, 1], R[0, 2] = 1.0 - n * (b * b + c * c), n * (a * b - w * c), n * (a * c + w * b)
    R[1, 0], R[1, 1], R[1, 2] = n * (a * b + w * c), 1.0 - n * (a * a + c * c), n * (b * c - w * a)
    R[2, 0], R[2, 1], R[2, 2] = n * (a * c - w * b), n * (b * c + w * a), 1.0 - n * (a * a + b * b)
    return R


@njit(cache=True, nogil=True)
def _power(model, x):  # type: ignore[no-untyped-def]
    """Electrical power, W: aerodynamic torque times speed over the drive's efficiency, and avionics."""
    m = model[0]
    watts = 0.0
    for i in range(13, 17):
        watts += m.k_torque * x[i] * x[i] * x[i]
    return watts / m.efficiency + m.avionics_w


@njit(cache=True, nogil=True)
def _volts(model, fraction, power):  # type: ignore[no-untyped-def]
    m = model[0]
    place = 10.0 * min(max(fraction, 0.0), 1.0)
    k = min(int(place), 9)
    source = m.volts[k] + (place - k) * (m.volts[k + 1] - m.volts[k])
    return 0.5 * (source + math.sqrt(max(source * source - 4.0 * m.resistance * power, 0.0)))
