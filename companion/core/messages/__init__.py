"""Every message type. Frame and unit stand in each field's name or comment.

`odom` and `map` are local ENU frames (z up), `body` is FLU, `sensor` is the sensor's own
frame. SI units, radians, quaternions wxyz, stamps in ns. Arrays are read-only once
published: a node copies before it writes.
"""

from companion.core.messages.estimates import (
    LioState,
    MapFromOdom,
    ObstacleTracks,
    Odometry,
    PoseCorrections,
    PoseLikelihood,
    RegisteredScan,
    SmoothedState,
)
from companion.core.messages.flight import (
    PROVEN,
    CommandResult,
    Goal,
    GroundTruth,
    Limits,
    MavlinkBytes,
    MissionStatus,
    NodeHealth,
    PlanStatus,
    SafetyStatus,
    Setpoint,
    Trajectory,
    VehicleCommand,
    VehicleStatus,
    Why,
)
from companion.core.messages.kind import Array, Array32, Bytes2D, freeze, message
from companion.core.messages.maps import Landmarks, LocalMap, MapDelta, MapStatus, OccupiedVoxels
from companion.core.messages.sensing import BaroReading, CameraImage, ImuSample, LidarScan, RangeReading

__all__ = [
    "PROVEN",
    "Array",
    "Array32",
    "BaroReading",
    "Bytes2D",
    "CameraImage",
    "CommandResult",
    "Goal",
    "GroundTruth",
    "ImuSample",
    "Landmarks",
    "LidarScan",
    "Limits",
    "LioState",
    "LocalMap",
    "MapDelta",
    "MapFromOdom",
    "MapStatus",
    "MavlinkBytes",
    "MissionStatus",
    "NodeHealth",
    "ObstacleTracks",
    "OccupiedVoxels",
    "Odometry",
    "PlanStatus",
    "PoseCorrections",
    "PoseLikelihood",
    "RangeReading",
    "RegisteredScan",
    "SafetyStatus",
    "Setpoint",
    "SmoothedState",
    "Trajectory",
    "VehicleCommand",
    "VehicleStatus",
    "Why",
    "freeze",
    "message",
]
