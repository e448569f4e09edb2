"""The kernels of the cascade in `control.py`; all NED/FRD, thrust and torque normalised."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

GRAVITY = 9.80665

# Gains of the position step.
(
    P_XY,
    P_Z,
    VP_XY,
    VI_XY,
    VD_XY,
    VP_Z,
    VI_Z,
    VD_Z,
    V_MAX,
    DOWN_MAX,
    THR_MIN,
    THR_MAX,
    MARGIN,
    DECOUPLE,
    LEARN,
) = range(15)
GAINS = 15
# Gains of the rate step: attitude P 0:3, heading weight 3, rate P 4:7, I 7:10, D 10:13,
# integral limit 13:16, rate limit 16:19, low-pass of rate and of its derivative, dt, thrust curve.
WEIGHT, RATE_P, RATE_I, RATE_D, INT_LIM, RATE_MAX, LP_RATE, LP_ACCEL, DT, CURVE = (
    3,
    4,
    7,
    10,
    13,
    16,
    19,
    20,
    21,
    22,
)
RATE_GAINS = 23
# What the position step leaves for the rate step and for telemetry.
THRUST, YAW_RATE, HOVER, V_DOWN = 0, 1, 2, 3
OUT = 4
# Memory of the rate step: filtered rate, its derivative, integral.
RATE, ACCEL, INTEGRAL = 0, 3, 6
RATE_STATE = 9


@njit(cache=True, nogil=True)
def position_step(sp, x, acceleration, limits, dt, gains, integral, q_sp, out):  # type: ignore[no-untyped-def]
    """Position and velocity control; see Controller.position."""
    climb, tilt, flying = limits[0], limits[1], limits[2]
    if flying > 1.5 and gains[LEARN] > 0.5:
        _learn_hover_thrust(x, acceleration, dt, out)
    v_sp, a_sp = np.empty(3), np.empty(3)
    _velocity_setpoint(sp, x, climb, gains, v_sp)
    error = np.empty(3)
    for i in range(3):
        error[i] = v_sp[i] - x[4 + i]
        kp, kd = (gains[VP_Z], gains[VD_Z]) if i == 2 else (gains[VP_XY], gains[VD_XY])
        a = 0.0 if math.isnan(error[i]) else kp * error[i] + integral[i] - kd * acceleration[i]
        a_sp[i] = a if math.isnan(sp[6 + i]) else a + sp[6 + i]
        if math.isnan(error[i]):
            error[i] = 0.0
    thrust = np.empty(3)
    _thrust_vector(a_sp, tilt, out[HOVER], gains, thrust)
    _saturate(a_sp, thrust, error, out[HOVER], gains)
    if flying > 0.5:
        for i in range(3):
            integral[i] += error[i] * dt * (gains[VI_Z] if i == 2 else gains[VI_XY])
        integral[2] = min(max(integral[2], -GRAVITY), GRAVITY)
    yaw_now = math.atan2(2 * (x[0] * x[3] + x[1] * x[2]), 1 - 2 * (x[2] * x[2] + x[3] * x[3]))
    _attitude_of(thrust, yaw_now if math.isnan(sp[9]) else sp[9], q_sp)
    out[THRUST] = math.sqrt(thrust[0] ** 2 + thrust[1] ** 2 + thrust[2] ** 2)
    out[YAW_RATE] = 0.0 if math.isnan(sp[10]) else sp[10]
    out[V_DOWN] = v_sp[2] if not math.isnan(v_sp[2]) else 0.0


@njit(cache=True, nogil=True)
def _learn_hover_thrust(x, acceleration, dt, out):  # type: ignore[no-untyped-def]
    """hover = thrust along the vertical / (1 - a_down/g), slowly (PX4 has a one-state filter for it)."""
    vertical = out[THRUST] * (1 - 2 * (x[1] * x[1] + x[2] * x[2]))
    load = 1.0 - acceleration[2] / GRAVITY
    if load > 0.5 and vertical > 0.05 and abs(x[6]) < 2.0:
        out[HOVER] += 0.3 * dt * (vertical / load - out[HOVER])
        out[HOVER] = min(max(out[HOVER], 0.1), 0.9)


@njit(cache=True, nogil=True)
def _velocity_setpoint(sp, x, climb, gains, v_sp):  # type: ignore[no-untyped-def]
    """Feed-forward plus position error; the error's share has priority within the horizontal limit."""
    from_p, ahead = np.zeros(3), np.zeros(3)
    for i in range(3):
        has_p, has_v = not math.isnan(sp[i]), not math.isnan(sp[3 + i])
        if has_p:
            from_p[i] = (gains[P_Z] if i == 2 else gains[P_XY]) * (sp[i] - x[7 + i])
        if has_v:
            ahead[i] = sp[3 + i]
        v_sp[i] = from_p[i] + ahead[i] if has_p or has_v else math.nan
    if not math.isnan(v_sp[0]) and not math.isnan(v_sp[1]):
        _limit_xy(from_p, ahead, gains[V_MAX], v_sp)
    if not math.isnan(v_sp[2]):
        v_sp[2] = min(max(v_sp[2], -climb), gains[DOWN_MAX])


@njit(cache=True, nogil=True)
def _limit_xy(first, second, top, v):  # type: ignore[no-untyped-def]
    """first + second within `top`: first is cut last."""
    if math.hypot(v[0], v[1]) <= top:
        return
    size = math.hypot(first[0], first[1])
    if size >= top:
        v[0], v[1] = first[0] * top / size, first[1] * top / size
        return
    along = first[0] * second[0] + first[1] * second[1]  # |first + s*second| = top
    square = second[0] ** 2 + second[1] ** 2
    s = (-along + math.sqrt(along * along + square * (top * top - size * size))) / square
    v[0], v[1] = first[0] + s * second[0], first[1] + s * second[1]


@njit(cache=True, nogil=True)
def _thrust_vector(a_sp, tilt, hover, gains, thrust):  # type: ignore[no-untyped-def]
    """Acceleration -> tilt-limited direction and collective thrust (NED, so it points to -z)."""
    up = GRAVITY if gains[DECOUPLE] > 0.5 else max(GRAVITY - a_sp[2], 0.1)
    horizontal = math.hypot(a_sp[0], a_sp[1])
    limited = min(horizontal, up * math.tan(tilt))
    scale = limited / horizontal if horizontal > 1e-9 else 0.0
    n = math.sqrt(limited * limited + up * up)
    cosine = up / n
    lift = (hover - a_sp[2] * hover / GRAVITY) / cosine
    collective = max(lift, gains[THR_MIN])
    thrust[0], thrust[1], thrust[2] = (
        a_sp[0] * scale / n * collective, a_sp[1] * scale / n * collective, -cosine * collective,
    )  # fmt: skip


@njit(cache=True, nogil=True)
def _saturate(a_sp, thrust, error, hover, gains):  # type: ignore[no-untyped-def]
    """Vertical before horizontal thrust, with a horizontal margin; saturated errors are not integrated."""
    top = gains[THR_MAX]
    if (thrust[2] >= -gains[THR_MIN] and error[2] >= 0) or (thrust[2] <= -top and error[2] <= 0):
        error[2] = 0.0
    xy = math.hypot(thrust[0], thrust[1])
    kept = min(xy, gains[MARGIN])
    thrust[2] = max(thrust[2], -math.sqrt(max(top * top - kept * kept, 0.0)))
    left = math.sqrt(max(top * top - thrust[2] * thrust[2], 0.0))
    if xy > left:
        thrust[0] *= left / xy
        thrust[1] *= left / xy
    made_x, made_y = thrust[0] * GRAVITY / hover, thrust[1] * GRAVITY / hover
    if a_sp[0] ** 2 + a_sp[1] ** 2 > made_x**2 + made_y**2:  # tracking anti-windup
        gain = 2.0 / gains[VP_XY]
        error[0] -= gain * (a_sp[0] - made_x)
        error[1] -= gain * (a_sp[1] - made_y)


@njit(cache=True, nogil=True)
def _attitude_of(thrust, yaw, q):  # type: ignore[no-untyped-def]
    """q_ned_frd whose -z axis is the thrust's direction and whose x axis points to `yaw`."""
    n = math.sqrt(thrust[0] ** 2 + thrust[1] ** 2 + thrust[2] ** 2)
    if n < 1e-6:
        bx, by, bz = 0.0, 0.0, 1.0
    else:
        bx, by, bz = -thrust[0] / n, -thrust[1] / n, -thrust[2] / n
    # Shortest turn from (0, 0, 1) to body z, after a turn by yaw about z.
    w, x, y = 1.0 + bz, -by, bx
    m = math.sqrt(w * w + x * x + y * y)
    w, x, y = w / m, x / m, y / m
    # The heading of that attitude is not yaw when it is tilted: turn about body z until it is.
    r00, r10 = 1 - 2 * y * y, 2 * x * y
    r01, r11 = 2 * x * y, 1 - 2 * x * x
    c, s = math.cos(yaw), math.sin(yaw)
    turn = math.atan2(r00 * s - r10 * c, r11 * c - r01 * s)
    cz, sz = math.cos(0.5 * turn), math.sin(0.5 * turn)
    q[0], q[1], q[2], q[3] = w * cz, x * cz + y * sz, y * cz - x * sz, w * sz


@njit(cache=True, nogil=True)
def rate_step(q, omega, q_sp, out, g, mixer, memory, rate_sp, motors):  # type: ignore[no-untyped-def]
    """Attitude P, rate PID and mixing; see Controller.rates."""
    _rate_setpoint(q, q_sp, out[YAW_RATE], g, rate_sp)
    torque, dt = np.empty(3), g[DT]
    for i in range(3):
        before = memory[RATE + i]
        memory[RATE + i] += g[LP_RATE] * (omega[i] - before)
        memory[ACCEL + i] += g[LP_ACCEL] * ((memory[RATE + i] - before) / dt - memory[ACCEL + i])
        error = rate_sp[i] - memory[RATE + i]
        torque[i] = g[RATE_P + i] * error + memory[INTEGRAL + i] - g[RATE_D + i] * memory[ACCEL + i]
        grown = memory[INTEGRAL + i] + g[RATE_I + i] * error * dt
        memory[INTEGRAL + i] = min(max(grown, -g[INT_LIM + i]), g[INT_LIM + i])
    _mix(torque, out[THRUST], mixer, motors)
    curve = g[CURVE]
    for i in range(4):
        t = min(max(motors[i], 0.0), 1.0)
        if curve > 1e-3:
            half = (1.0 - curve) / (2.0 * curve)
            t = math.sqrt(half * half + t / curve) - half
        motors[i] = t


@njit(cache=True, nogil=True)
def _rate_setpoint(q, q_sp, yaw_rate, g, rate_sp):  # type: ignore[no-untyped-def]
    """Reduced attitude (thrust direction) at full gain, heading at its weight; rates limited."""
    # e = conj(q) * q_sp: the whole error in the body frame.
    e0 = q[0] * q_sp[0] + q[1] * q_sp[1] + q[2] * q_sp[2] + q[3] * q_sp[3]
    e1 = q[0] * q_sp[1] - q[1] * q_sp[0] - q[2] * q_sp[3] + q[3] * q_sp[2]
    e2 = q[0] * q_sp[2] + q[1] * q_sp[3] - q[2] * q_sp[0] - q[3] * q_sp[1]
    e3 = q[0] * q_sp[3] - q[1] * q_sp[2] + q[2] * q_sp[1] - q[3] * q_sp[0]
    # e = tilt * heading with tilt about an axis in the body's xy plane.
    n = math.sqrt(e0 * e0 + e3 * e3)
    if n > 1e-6:
        c, s = e0 / n, e3 / n
        t1, t2 = e1 * c - e2 * s, e1 * s + e2 * c
        tilt0 = n
    else:
        c, s, t1, t2, tilt0 = 1.0, 0.0, e1, e2, 0.0
    angle = g[WEIGHT] * math.atan2(s, c) if c >= 0 else g[WEIGHT] * math.atan2(-s, -c)
    hw, hz = math.cos(angle), math.sin(angle)
    # Recombine: tilt * heading of reduced angle.
    r0, r1, r2, r3 = tilt0 * hw, t1 * hw + t2 * hz, t2 * hw - t1 * hz, tilt0 * hz
    sign = 2.0 if r0 >= 0 else -2.0
    rate_sp[0] = sign * r1 * g[0]
    rate_sp[1] = sign * r2 * g[1]
    rate_sp[2] = sign * r3 * g[2] / max(g[WEIGHT], 0.1)
    # The yaw rate turns about the world's down axis.
    rate_sp[0] += 2 * (q[1] * q[3] - q[0] * q[2]) * yaw_rate
    rate_sp[1] += 2 * (q[2] * q[3] + q[0] * q[1]) * yaw_rate
    rate_sp[2] += (1 - 2 * (q[1] * q[1] + q[2] * q[2])) * yaw_rate
    for i in range(3):
        rate_sp[i] = min(max(rate_sp[i], -g[RATE_MAX + i]), g[RATE_MAX + i])


@njit(cache=True, nogil=True)
def _mix(torque, thrust, mixer, motors):  # type: ignore[no-untyped-def]
    """Roll and pitch before thrust before yaw: thrust gives way downwards, then yaw is cut."""
    low, high = 0.0, 0.0
    for i in range(4):
        motors[i] = mixer[i, 0] * torque[0] + mixer[i, 1] * torque[1]
        low, high = min(low, motors[i]), max(high, motors[i])
    scale = 1.0 / max(high - low, 1.0)
    base = min(thrust, 1.0 - high * scale)
    if base + low * scale < 0.0:  # never add thrust; give up roll and pitch instead (no airmode)
        scale = base / -low
    share = 1.0
    for i in range(4):
        yaw = mixer[i, 2] * torque[2]
        motors[i] = base + scale * motors[i]
        room = (1.0 - motors[i]) if yaw > 0 else motors[i]
        if abs(yaw) > max(room, 0.0):
            share = min(share, max(room, 0.0) / abs(yaw))
    for i in range(4):
        motors[i] += share * mixer[i, 2] * torque[2]
