"""What the simulator can be told; every value has a `--set sim.<key>=<value>`."""

from __future__ import annotations

from typing import Annotated

import msgspec

from companion.core.rig import Rig
from sim.autopilot.readings import AutopilotConfig
from sim.sensors.baro import BaroConfig
from sim.sensors.camera import CameraConfig
from sim.sensors.gps import GpsConfig
from sim.sensors.imu import ImuConfig
from sim.sensors.lidar import LidarConfig
from sim.sensors.range_finder import RangeFinderConfig
from sim.vehicle.wind import WindConfig

Milliseconds = Annotated[float, msgspec.Meta(ge=0, le=500)]


class LatencyConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """From the stamp of a sample to the moment when the companion computer has it."""

    imu_ms: Milliseconds = 1.0
    lidar_ms: Milliseconds = 10.0  # after the end of the sweep
    camera_ms: Milliseconds = 25.0  # exposure to memory, USB
    range_ms: Milliseconds = 5.0
    baro_ms: Milliseconds = 5.0
    link_ms: Milliseconds = 2.0  # MAVLink, one way


class SimConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The simulated aircraft and its surroundings."""

    start_yaw_deg: float = 0.0
    open_sky: bool = False  # the autopilot has compass and GPS: it flies without a companion, too
    render: bool = True  # LiDAR and camera; without them less is computed
    rig: Rig = Rig()  # where the sensors truly sit; the stack has its own calibration
    lidar: LidarConfig = LidarConfig()
    camera: CameraConfig = CameraConfig()
    imu: ImuConfig = ImuConfig()
    autopilot_imu: ImuConfig = ImuConfig(rate_hz=400.0)
    baro: BaroConfig = BaroConfig()
    gps: GpsConfig = GpsConfig()
    range_finder: RangeFinderConfig = RangeFinderConfig()
    wind: WindConfig = WindConfig()
    autopilot: AutopilotConfig = AutopilotConfig()
    latency: LatencyConfig = LatencyConfig()
