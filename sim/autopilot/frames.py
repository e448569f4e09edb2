"""ENU/FLU of the simulator <-> NED/FRD of the autopilot, and the flat-earth map projection.

Written apart from the stack's `companion.autopilot.frames` on purpose: a sign error in one
of the two shows in flight instead of cancelling out. Source of the axes: REP-103, MAV_FRAME.
"""

from __future__ import annotations

import math

import numpy as np

from companion.core.messages import Array

EARTH_RADIUS_M = 6_371_000.0  # PX4's sphere


def ned_from_enu(v: Array) -> Array:
    """World vector (3,); the map is its own inverse."""
    return np.array([v[1], v[0], -v[2]])


def frd_from_flu(v: Array) -> Array:
    """Body vector (3,); the map is its own inverse."""
    return np.array([v[0], -v[1], -v[2]])


def euler_from_quaternion(q: Array) -> tuple[float, float, float]:
    """q_ned_frd wxyz -> roll, pitch, yaw (Z-Y-X), rad."""
    w, x, y, z = q
    roll = math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = math.asin(max(-1.0, min(1.0, 2 * (w * y - z * x))))
    return roll, pitch, math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))


def quaternion_from_euler(roll: float, pitch: float, yaw: float) -> Array:
    """Roll, pitch, yaw (Z-Y-X), rad -> q_ned_frd wxyz."""
    cr, sr = math.cos(roll / 2), math.sin(roll / 2)
    cp, sp = math.cos(pitch / 2), math.sin(pitch / 2)
    cy, sy = math.cos(yaw / 2), math.sin(yaw / 2)
    return np.array(
        [
            cr * cp * cy + sr * sp * sy,
            sr * cp * cy - cr * sp * sy,
            cr * sp * cy + sr * cp * sy,
            cr * cp * sy - sr * sp * cy,
        ]
    )


def geodetic(origin: tuple[float, float, float], p_ned: Array) -> tuple[float, float, float]:
    """Latitude and longitude in degrees and altitude in m of a local point; good within some km."""
    latitude, longitude, altitude = origin
    north = math.degrees(p_ned[0] / EARTH_RADIUS_M)
    east = math.degrees(p_ned[1] / (EARTH_RADIUS_M * math.cos(math.radians(latitude))))
    return latitude + north, longitude + east, altitude - p_ned[2]


def local(origin: tuple[float, float, float], latitude: float, longitude: float, altitude: float) -> Array:
    """The inverse of `geodetic`: p_ned, (3,)."""
    east_radius = EARTH_RADIUS_M * math.cos(math.radians(origin[0]))
    return np.array(
        [
            math.radians(latitude - origin[0]) * EARTH_RADIUS_M,
            math.radians(longitude - origin[1]) * east_radius,
            origin[2] - altitude,
        ]
    )


def turn_about_down(angle: float) -> Array:
    """Rotation matrix (3, 3) about NED's z axis; positive turns north to east."""
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
