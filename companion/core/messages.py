"""Every message type. Frame and unit stand in each field's name or comment.

`odom` and `map` are local ENU frames (z up), `body` is FLU, `sensor` is the sensor's own
frame. SI units, radians, quaternions wxyz, stamps in ns. Arrays are read-only once
published: a node copies before it writes.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal, TypeVar, dataclass_transform

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Array32 = NDArray[np.float32]
Bytes2D = NDArray[np.uint8]
T = TypeVar("T")


@dataclass_transform(frozen_default=True, kw_only_default=True, eq_default=False)
def message(kind: type[T]) -> type[T]:
    """Frozen, slotted, keywords only; compared by identity since arrays have no single truth."""
    return dataclass(frozen=True, slots=True, kw_only=True, eq=False)(kind)


# --- sensors ------------------------------------------------------------------------


@message
class ImuSample:
    """Mean over the sample interval that ends at the stamp."""

    stamp_ns: int
    angular_velocity_body: Array  # rad/s, (3,)
    specific_force_body: Array  # m/s2, (3,); +9.81 on z at rest and level


@message
class LidarScan:
    """One sweep, not deskewed. The stamp is the end of the sweep."""

    stamp_ns: int
    points_sensor: Array32  # returns, m, (N, 3), each in the sensor frame of its own time
    point_age_s: Array32  # (N,), >= 0: stamp minus the time of the point
    miss_dirs_sensor: Array32  # unit directions of beams without return, (M, 3)
    miss_age_s: Array32  # (M,)


@message
class CameraImage:
    """One global-shutter frame of the downward camera; the stamp is mid-exposure."""

    stamp_ns: int
    pixels: Bytes2D  # grey, (H, W)


@message
class RangeReading:
    """Downward range finder along body -z; NaN: no return."""

    stamp_ns: int
    range_m: float


@message
class BaroReading:
    """Barometric altitude above an arbitrary, slowly drifting zero."""

    stamp_ns: int
    altitude_m: float


# --- estimation ---------------------------------------------------------------------


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


# --- mapping ------------------------------------------------------------------------


@message
class LocalMap:
    """Immutable snapshot around the vehicle: what is known, and how far obstacles are."""

    stamp_ns: int
    origin_odom: Array  # corner of cell (0, 0, 0), m, (3,)
    resolution_m: float
    state: NDArray[np.uint8]  # 0 unknown, 1 free, 2 occupied, (X, Y, Z)
    distance_m: Array32  # to the nearest occupied cell's surface, truncated, (X, Y, Z)
    unknown_distance_m: Array32  # to the nearest cell that is not known free, truncated; (0, 0, 0): nobody asks for it
    ground_z_odom: Array32  # lowest ground seen per column, NaN: none, (X, Y)


@message
class Landmarks:
    """Single things of the feature map, one row each, ordered by id."""

    stamp_ns: int  # of the newest image inside
    id: NDArray[np.int64]  # (N,), never given twice
    position_odom: Array  # m, (N, 3); of a trunk: its axis at breast height
    sigma_m: Array  # root of the mean variance of the three axes, (N,)
    kind: NDArray[np.uint8]  # 0 visual, 1 trunk, (N,)
    radius_m: Array  # NaN: has none, (N,)
    observations: NDArray[np.int64]  # (N,)


@message
class MapStatus:
    """How old and how large the map is: for whoever needs no cells."""

    stamp_ns: int  # of the newest scan inside the newest local map
    scans: int  # taken in so far
    blocks: int  # of 8 x 8 x 8 voxels, alive
    cold_blocks: int  # of them, compressed because they are far
    forgotten_blocks: int  # dropped since the map began, because it did not fit the budget
    memory_bytes: int  # of the map


@message
class OccupiedVoxels:
    """The map as a viewer wants it."""

    stamp_ns: int  # of the newest scan inside
    points_odom: Array32  # centres of the occupied voxels, m, (N, 3)
    log_odds: Array32  # of being occupied, (N,)


@message
class MapDelta:
    """Blocks of 8 x 8 x 8 voxels whose classes changed; `companion.mapping.mirror` keeps a map by it."""

    stamp_ns: int  # of the newest scan inside
    map_ns: int  # stamp of the map's first scan: a map that begins anew counts versions anew
    version_from: int  # every block changed after this version is inside; 0: the whole map
    version_to: int
    resolution_m: float
    block_count: int
    data: bytes  # LZ4 frame of one record of 140 bytes per block, as in MapDelta.msg


# --- mission ------------------------------------------------------------------------


@message
class Limits:
    """What a step allows; the unit is in the comment since messages carry no options."""

    speed: float  # m/s
    climb: float  # m/s
    accel: float  # m/s2
    yaw_rate: float  # rad/s
    clearance: float  # hull to obstacle, m
    unknown: Literal["blocked", "stop_before", "optimistic"]
    agl_min: float  # m
    agl_max: float  # m


@message
class Goal:
    """Where to fly next. A new id replaces the old; `hold` stops in known-free space, `land` over a free column."""

    stamp_ns: int
    id: int
    kind: Literal["takeoff", "fly", "hold", "land"]
    p_odom: Array  # (3,)
    agl_m: float  # height above ground asked for; NaN: p_odom[2] holds
    radius_m: float  # reached within
    fly_through: bool  # do not stop there
    next_p_odom: Array  # (K, 3), goals that follow, for looking ahead
    yaw: float  # rad in odom; NaN: along the path
    if_blocked: Literal["nearest_free", "fail"]
    limits: Limits


@message
class VehicleCommand:
    """What the mission asks of the autopilot."""

    stamp_ns: int
    kind: Literal["arm", "disarm", "offboard", "hold", "land", "return"]


@message
class MissionStatus:
    stamp_ns: int
    step_id: str
    step_index: int
    step_count: int
    state: Literal["waiting", "running", "failing", "done", "failed"]
    reason: str


@message
class Why:
    """One decision: what was done, because of which input."""

    stamp_ns: int
    node: str
    what: str
    because: str


# --- planning and tracking ----------------------------------------------------------


@message
class Trajectory:
    """A path to track; the last point has speed 0 and lies in known-free space."""

    stamp_ns: int
    goal_id: int
    p_odom: Array  # (N, 3), spaced evenly
    speed: Array  # m/s, (N,)
    accel_limit: float  # m/s2
    yaw: float  # rad; NaN: along the path
    yaw_rate_limit: float  # rad/s


PROVEN = "no way"  # begins PlanStatus.reason when the planner has proven it on the present map


@message
class PlanStatus:
    stamp_ns: int
    goal_id: int
    state: Literal["idle", "flying", "reached", "blocked"]
    distance_m: float  # along the plan, to the goal
    plan_p_odom: Array  # the geometric plan, (N, 3)
    cost_m: float
    iterations: int
    reason: str = ""  # why it is blocked; PROVEN begins the words of a proof that there is no way
    checked: int = 0  # ways that were traversed voxel by voxel before they were published
    refused: int = 0  # of them, those that met something seen: braked on before it


@message
class Setpoint:
    """Demand for the autopilot; NaN components are not controlled."""

    stamp_ns: int
    p_odom: Array  # (3,)
    v_odom: Array  # (3,)
    a_odom: Array  # (3,)
    yaw: float  # rad
    yaw_rate: float  # rad/s


@message
class SafetyStatus:
    """The guards' verdict; `speed_scale` bounds the tracker, `hold` brakes on the path."""

    stamp_ns: int
    action: Literal["ok", "slow", "hold", "land"]
    speed_scale: float
    reason: str


@message
class NodeHealth:
    """Whether a node of a live stack runs; said by who started it, when that changes."""

    stamp_ns: int
    node: str
    alive: bool
    reason: str  # why it is down


# --- autopilot ----------------------------------------------------------------------


@message
class MavlinkBytes:
    """Raw bytes as read from or written to the link."""

    stamp_ns: int
    data: bytes


@message
class VehicleStatus:
    """What the autopilot says of itself, in our frames."""

    stamp_ns: int
    connected: bool
    armed: bool
    mode: str  # OFFBOARD, HOLD, TAKEOFF, LAND, RETURN, MANUAL, ...
    landed: bool
    ready: bool  # would accept to arm
    battery_fraction: float
    p_odom: Array  # the autopilot's own estimate, (3,)
    v_odom: Array  # (3,)
    text: str  # newest STATUSTEXT


@message
class CommandResult:
    stamp_ns: int
    kind: str  # of VehicleCommand
    accepted: bool
    reason: str


# --- truth: only the runtime's report reads it ---------------------------------------


@message
class GroundTruth:
    """The simulator's own state; no stage subscribes to it."""

    stamp_ns: int
    p_world: Array  # (3,)
    q_world_body: Array  # (4,)
    v_world: Array  # (3,)
    clearance_m: float  # smallest hull clearance since the last message
    contact: str  # "" or what was touched
    armed: bool
    battery_fraction: float


def freeze(value: Any) -> Any:
    """Make the arrays of a message read-only; returns the message."""
    for name in value.__slots__:
        part = getattr(value, name)
        if isinstance(part, np.ndarray):
            part.flags.writeable = False
    return value
