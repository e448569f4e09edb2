"""What the estimators say."""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray

from companion.core.messages.kind import Array, Array32, message


@message
class LioState:
    """Front-end filter state right after an update, at the time of the measurement."""

    stamp_ns: int
    p_odom: Array  # (3,)
    q_odom_body: Array  # wxyz, (4,)
    v_odom: Array  # (3,)
    gyro_bias_body: Array  # rad/s, (3,)
    accel_bias_body: Array  # m/s2, (3,)
    gravity_odom: Array  # m/s2, (3,), about (0, 0, -9.81)
    covariance: Array  # (18, 18), order theta_body p v bg ba g
    source: Literal["start", "lidar", "camera"]
    inlier_fraction: float  # of the registered points
    weakest_direction: float  # smallest normalised eigenvalue of the registration, 0..1
    doubts: str = ""  # what the front end cannot vouch for: weak axes, sensors; "": nothing


@message
class PoseLikelihood:
    """What one measurement alone says of a pose: normal equations without the IMU prior.

    0.5 dx' H dx - g' dx around the linearisation pose, dx = (theta_body, p_odom).
    """

    stamp_ns: int
    p_odom: Array  # (3,)
    q_odom_body: Array  # (4,)
    information: Array  # H, (6, 6)
    gradient: Array  # g, (6,)
    source: Literal["lidar", "camera"]


@message
class RegisteredScan:
    """A sweep deskewed into the body frame of its stamp, with the pose that it got."""

    stamp_ns: int
    points_body: Array32  # (N, 3)
    miss_dirs_body: Array32  # (M, 3)
    origin_body: Array  # sensor position, (3,)
    p_odom: Array  # (3,)
    q_odom_body: Array  # (4,)


@message
class Odometry:
    """Continuous pose in `odom`: never jumps more than a filter correction."""

    stamp_ns: int
    p_odom: Array  # (3,)
    q_odom_body: Array  # (4,)
    v_odom: Array  # (3,)
    omega_body: Array  # rad/s, (3,)
    pose_variance: Array  # diagonal, theta_body then p_odom, (6,)
    velocity_variance: Array  # (3,)
    measured_ns: int  # stamp of the newest LiDAR or camera update inside
    quality: float  # 0..1, falls with the standard deviation of the position; 0 when dead reckoning or lost
    reset_counter: int
    health: Literal["nominal", "degraded", "lost"] = "nominal"
    health_reason: str = ""  # which sensor, which axis; "": nominal


@message
class SmoothedState:
    """The factor graph's newest state and the correction of `odom` in `map`."""

    stamp_ns: int
    p_map: Array  # (3,)
    q_map_body: Array  # (4,)
    v_map: Array  # (3,)
    gyro_bias_body: Array  # (3,)
    accel_bias_body: Array  # (3,)
    p_map_odom: Array  # (3,)
    q_map_odom: Array  # (4,)
    pose_variance: Array  # (6,)
    factors: int  # alive in the smoother


@message
class PoseCorrections:
    """Where poses of the past belong, the newest word on all of the flight.

    Only how they lie to each other counts: the newest of them does not move in `odom`.
    """

    stamp_ns: int
    stamps_ns: NDArray[np.int64]  # of the corrected poses, ascending, (K,)
    p_odom: Array  # (K, 3)
    q_odom_body: Array  # (K, 4)


@message
class MapFromOdom:
    """Where loops put `odom` in the corrected map; identity until a closure. It may jump, `odom` never does."""

    stamp_ns: int
    p_map_odom: Array  # (3,)
    q_map_odom: Array  # (4,)
    closures: int  # that hold


@message
class ObstacleTracks:
    """Things that move, one row each, by id: Kalman filters of constant velocity.

    Axes are alike and apart: a row's covariance of (p, v) is [[a, c], [c, b]] for each axis, with a, b and c the
    variances of position and velocity and what they share.
    """

    stamp_ns: int  # of the scan
    id: NDArray[np.int64]  # (N,), never given twice
    position_odom: Array  # middle of what is seen of it, m, (N, 3)
    velocity_odom: Array  # m/s, (N, 3)
    position_variance: Array  # m2, (N,)
    velocity_variance: Array  # m2/s2, (N,)
    cross_covariance: Array  # m2/s, (N,)
    radius_m: Array  # half its width in plan, as seen, (N,)
