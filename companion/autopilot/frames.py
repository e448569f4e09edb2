"""The only conversions between our frames and MAVLink's: ENU/FLU <-> NED/FRD.

World: `odom` is ENU-like (x "east", y "north", z up; its heading is arbitrary), the
autopilot's local frame is NED: x_ned = y_enu, y_ned = x_enu, z_ned = -z_enu. Body: FLU
(forward, left, up) against FRD (forward, right, down). Both maps are involutions: one
function serves both directions. Setpoints, ODOMETRY and LOCAL_POSITION_NED all pass here,
so they agree whatever the heading of `odom` is.

Source of the axis definitions: REP-103 and MAVLink's MAV_FRAME.
"""

from __future__ import annotations

import math

import numpy as np

from companion.core.geometry import wrap_angle
from companion.core.messages import Array

_HALF_SQRT2 = math.sqrt(0.5)


def swap_world(v: Array) -> Array:
    """World vector ENU -> NED, or NED -> ENU; (3,) -> (3,)."""
    return np.array([v[1], v[0], -v[2]])


def swap_body(v: Array) -> Array:
    """Body vector FLU -> FRD, or FRD -> FLU; (3,) -> (3,)."""
    return np.array([v[0], -v[1], -v[2]])


def swap_attitude(q: Array) -> Array:
    """Attitude q_enu_flu -> q_ned_frd, or back; wxyz (4,) -> (4,).

    q_ned_frd = q_ned_enu * q_enu_flu * q_flu_frd with half turns about (1, 1, 0)/sqrt(2)
    and about x, multiplied out (sign chosen so that the map is its own inverse).
    """
    w, x, y, z = q
    return np.array([w + z, x + y, x - y, w - z]) * _HALF_SQRT2


def swap_yaw(yaw: float) -> float:
    """Heading from +x east, positive left -> from north, positive right, or back; rad, (-pi, pi]."""
    return wrap_angle(math.pi / 2 - yaw)


def swap_yaw_rate(yaw_rate: float) -> float:
    """Rate about up -> about down, or back; rad/s."""
    return -yaw_rate


def swap_world_variance(variance: Array) -> Array:
    """Diagonal of a world covariance, ENU -> NED, or back; (3,) -> (3,)."""
    return np.array([variance[1], variance[0], variance[2]])


def swap_body_variance(variance: Array) -> Array:
    """Diagonal of a body covariance: mirrored axes keep their variance; (3,) -> (3,)."""
    return np.array(variance, dtype=np.float64)
