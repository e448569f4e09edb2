"""Our setpoints and odometry as MAVLink messages, in the autopilot's frames.

Sources: MAVLink POSITION_TARGET_TYPEMASK, MAV_FRAME, MAV_ESTIMATOR_TYPE; what PX4 and
ArduPilot both accept was observed on both (docs/mavlink.md).
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np

from companion.autopilot import frames
from companion.autopilot.codec import Odometry as OdometryNed
from companion.autopilot.codec import SetPositionTarget
from companion.autopilot.modes import Flavour
from companion.core.geometry import quaternion_conjugate, rotation_from_quaternion
from companion.core.messages import Array, Odometry, Setpoint

LOCAL_NED: Final = 1  # MAV_FRAME
LOCAL_FRD: Final = 20
BODY_FRD: Final = 12
ESTIMATOR_VIO: Final = 3
IGNORE_YAW: Final = 1 << 10
IGNORE_YAW_RATE: Final = 1 << 11
_IGNORE_AXES: Final = 7  # shifted by 0 for position, 3 for velocity, 6 for acceleration
_SANE_MAX: Final = 1e9  # beyond: not a demand but a fault, and float32 could overflow
_DIAGONAL: Final = [0, 6, 11, 15, 18, 20]  # of a 6x6 upper triangle, row-major


class Target(NamedTuple):
    """Whom we address."""

    system: int
    component: int


def setpoint_message(setpoint: Setpoint, target: Target, flavour: Flavour) -> SetPositionTarget | None:
    """The setpoint in LOCAL_NED; what is not finite is masked out. None if no axis is left.

    PX4 masks each axis for itself, ArduCopter knows whole triples only: there a triple with
    a missing axis is left out whole.
    """
    values: list[float] = []
    mask = 0
    for shift, demand in ((0, setpoint.p_odom), (3, setpoint.v_odom), (6, setpoint.a_odom)):
        triple, ignored = _masked(frames.swap_world(demand), whole=flavour == "ardupilot")
        values += triple
        mask |= ignored << shift
    if mask == 0b111_111_111:
        return None
    yaw = yaw_rate = 0.0
    if _sane(setpoint.yaw):
        yaw = frames.swap_yaw(setpoint.yaw)
    else:
        mask |= IGNORE_YAW
    if _sane(setpoint.yaw_rate):
        yaw_rate = frames.swap_yaw_rate(setpoint.yaw_rate)
    else:
        mask |= IGNORE_YAW_RATE
    boot_ms = setpoint.stamp_ns // 1_000_000 & 0xFFFFFFFF
    return SetPositionTarget._make((boot_ms, *values, yaw, yaw_rate, mask, *target, LOCAL_NED))


def _masked(triple: Array, *, whole: bool) -> tuple[list[float], int]:
    """Values with 0 where ignored, and the three ignore bits."""
    ignored = sum(1 << i for i, value in enumerate(triple) if not _sane(value))
    if whole and ignored:
        ignored = _IGNORE_AXES
    return [0.0 if ignored >> i & 1 else float(value) for i, value in enumerate(triple)], ignored


def _sane(value: float) -> bool:
    return abs(value) < _SANE_MAX  # false for NaN


def odometry_message(odometry: Odometry, *, stamp_ns: int, rate_variance: float) -> OdometryNed | None:
    """Pose in LOCAL_FRD, twist in BODY_FRD, diagonal variances. None if anything is not finite.

    `stamp_ns` is the stamp to send; `rate_variance` in (rad/s)^2 fills the body rates, of
    which Odometry carries no variance.
    """
    o = odometry
    parts = (o.p_odom, o.q_odom_body, o.v_odom, o.omega_body, o.pose_variance, o.velocity_variance)
    if not all(np.all(np.abs(part) < _SANE_MAX) for part in parts):
        return None
    R_body_odom = rotation_from_quaternion(quaternion_conjugate(o.q_odom_body))
    pose_variance = np.concatenate(
        [frames.swap_world_variance(o.pose_variance[3:]), frames.swap_body_variance(o.pose_variance[:3])]
    )
    velocity_variance = np.append(frames.swap_body_variance(R_body_odom**2 @ o.velocity_variance), [rate_variance] * 3)
    return OdometryNed._make(
        (
            stamp_ns // 1000,
            *frames.swap_world(o.p_odom).tolist(),
            tuple(frames.swap_attitude(o.q_odom_body).tolist()),
            *frames.swap_body(R_body_odom @ o.v_odom).tolist(),
            *frames.swap_body(o.omega_body).tolist(),
            _triangle(pose_variance),
            _triangle(velocity_variance),
            LOCAL_FRD,
            BODY_FRD,
            o.reset_counter & 0xFF,
            ESTIMATOR_VIO,
            round(100 * min(max(o.quality, 0.0), 1.0)),
        )
    )


def _triangle(diagonal: Array) -> tuple[float, ...]:
    triangle = np.zeros(21)
    triangle[_DIAGONAL] = diagonal
    return tuple(triangle.tolist())
