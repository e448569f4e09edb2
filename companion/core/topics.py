"""Every topic of the stack, in the order of the data flow."""

from __future__ import annotations

from typing import Any

from companion.core import messages as m
from companion.core.node import Topic

# sensors
IMU = Topic(
    "sensors/imu", m.ImuSample, 200.0, "all", deadline_s=0.05, service="control", ros_type="sensor_msgs/msg/Imu"
)
LIDAR = Topic(
    "sensors/lidar",
    m.LidarScan,
    10.0,
    recorded=False,
    deadline_s=0.35,
    service="bulk",
    ros_type="sensor_msgs/msg/PointCloud2",
)
CAMERA = Topic(
    "sensors/camera",
    m.CameraImage,
    15.0,
    recorded=False,
    deadline_s=0.3,
    service="bulk",
    ros_type="sensor_msgs/msg/Image",
)
RANGE = Topic("sensors/range", m.RangeReading, 20.0, deadline_s=0.3, ros_type="sensor_msgs/msg/Range")
BARO = Topic("sensors/baro", m.BaroReading, 20.0, deadline_s=0.5, ros_type="sensor_msgs/msg/FluidPressure")
# autopilot in
MAVLINK_RX = Topic("mavlink/rx", m.MavlinkBytes, 0.0, "all")
VEHICLE = Topic("autopilot/vehicle", m.VehicleStatus, 10.0, deadline_s=1.0)
COMMAND_RESULT = Topic("autopilot/command_result", m.CommandResult, 0.0, "all")
# estimation
LIO_STATE = Topic("estimation/lio_state", m.LioState, 25.0, "all", service="control")
LIKELIHOOD = Topic("estimation/likelihood", m.PoseLikelihood, 25.0, "all")
REGISTERED = Topic("estimation/registered_scan", m.RegisteredScan, 10.0, recorded=False, service="bulk")
ODOMETRY = Topic("estimation/odometry", m.Odometry, 100.0, deadline_s=0.2, service="control")
SMOOTHED = Topic("estimation/smoothed", m.SmoothedState, 10.0)
CORRECTIONS = Topic("estimation/corrections", m.PoseCorrections, 0.0, service="latched")
MAP_FROM_ODOM = Topic("estimation/map_from_odom", m.MapFromOdom, 0.0, service="latched")
OBSTACLE_TRACKS = Topic("estimation/obstacle_tracks", m.ObstacleTracks, 0.0)  # 5 Hz while there are any
# mapping
LOCAL_MAP = Topic("mapping/local_map", m.LocalMap, 5.0, recorded=False, deadline_s=1.0, service="bulk")
MAP_STATUS = Topic("mapping/status", m.MapStatus, 5.0, deadline_s=1.0)
LANDMARKS = Topic("mapping/landmarks", m.Landmarks, 0.2, recorded=False, service="bulk")
OCCUPIED = Topic(
    "mapping/occupied",
    m.OccupiedVoxels,
    0.0,  # 2 Hz at most, when the map changed
    recorded=False,
    service="history",
    ros_type="sensor_msgs/msg/PointCloud2",
)
MAP_DELTA = Topic("mapping/delta", m.MapDelta, 0.0, "all", recorded=False, service="history")
MAP_FULL = Topic("mapping/full", m.MapDelta, 0.0, recorded=False, service="history")
# mission
GOAL = Topic("mission/goal", m.Goal, 0.0, service="latched")  # a planner that starts again needs it
VEHICLE_COMMAND = Topic("mission/vehicle_command", m.VehicleCommand, 0.0, "all", service="control")
MISSION = Topic("mission/status", m.MissionStatus, 2.0)
WHY = Topic("why", m.Why, 0.0, "all")
# planning
TRAJECTORY = Topic("planning/trajectory", m.Trajectory, 5.0)
PLAN = Topic("planning/status", m.PlanStatus, 5.0)
# safety, tracking
HEALTH = Topic("runtime/health", m.NodeHealth, 0.0, "all", service="control")
SAFETY = Topic("safety/status", m.SafetyStatus, 20.0, deadline_s=0.2, service="control")
SETPOINT = Topic("tracking/setpoint", m.Setpoint, 50.0, deadline_s=0.2, service="control")
# autopilot out
MAVLINK_TX = Topic("mavlink/tx", m.MavlinkBytes, 0.0, "all", service="control")
# the simulator's own word, for the report alone
TRUTH = Topic("truth", m.GroundTruth, 50.0)

ALL: tuple[Topic[Any], ...] = tuple(v for v in list(vars().values()) if isinstance(v, Topic))
BY_NAME: dict[str, Topic[Any]] = {t.name: t for t in ALL}
