"""What is built into the simulated autopilot: the airframe it flies, its readings, its configuration."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, NamedTuple

import msgspec

from companion.core.messages import Array

NonNegative = Annotated[float, msgspec.Meta(ge=0)]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Airframe:
    """The quad as its builder described it to the autopilot; rotor order is that of the commands."""

    mass_kg: float
    inertia_kg_m2: Array  # about body x, y, z, (3,)
    rotor_xy_m: Array  # rotor positions in the body frame FLU, (4, 2)
    rotor_spin: Array  # +1: turns counter-clockwise seen from above, -1: clockwise, (4,)
    max_thrust_n: float  # of one rotor at full command
    torque_per_thrust_m: float  # reaction torque over thrust
    motor_time_s: float  # time constant of the motors
    thrust_curve: float = 1.0  # thrust/max = c*u^2 + (1-c)*u of the command u; PX4's THR_MDL_FAC


class GpsFix(NamedTuple):
    """One fix of the GNSS receiver, as the vehicle's own sensor reports it."""

    p_enu_m: tuple[float, float, float]  # of the antenna, from the origin of the map
    v_enu: tuple[float, float, float]  # m/s
    horizontal_sigma_m: float = 0.9
    vertical_sigma_m: float = 1.8
    speed_sigma: float = 0.4  # m/s
    fix_type: int = 3  # MAVLink's GPS_FIX_TYPE; below 3 it is not fused
    satellites: int = 12


class ExternalPose(NamedTuple):
    """What the companion's ODOMETRY says; NaN where it says nothing."""

    stamp_ns: int
    p: Array  # m, (3,)
    v: Array  # m/s, (3,)
    v_in_body: bool
    yaw: float
    variance: Array  # p (3), v (3), yaw: (7,)
    aligned_with_north: bool  # frame LOCAL_NED instead of LOCAL_FRD
    reset_counter: int
    quality: int


class AutopilotConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """What the owner set; `parameters` overrides PX4's parameters by name."""

    system_id: Annotated[int, msgspec.Meta(ge=1, le=250)] = 1
    """MAVLink system id; the component is 1."""
    boot_offset_s: NonNegative = 7.25
    """Autopilot time since boot at simulation time 0: its clock is not the companion's."""
    origin_latitude_deg: Annotated[float, msgspec.Meta(ge=-89, le=89)] = 47.397742
    """Geodetic origin of the ENU map that GPS fixes refer to."""
    origin_longitude_deg: Annotated[float, msgspec.Meta(ge=-180, le=180)] = 8.545594
    """As above."""
    origin_altitude_m: float = 488.0
    """Altitude above mean sea level of that origin."""
    boot_heading_deg: float | None = None
    """Heading (from north, clockwise) that a compass gave at boot; None: no compass, heading by ODOMETRY."""
    battery_cells: Annotated[int, msgspec.Meta(ge=1, le=16)] = 4
    """Cells in series of the battery (BAT1_N_CELLS)."""
    parameters: dict[str, float] = {}
    """Parameter values that differ from the defaults in `sim/autopilot/params.py`."""
