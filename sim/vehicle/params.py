"""The aircraft's figures: one strict struct per part, read from TOML, packed for the kernels."""

from __future__ import annotations

import math
import tomllib
from pathlib import Path
from typing import Annotated

import msgspec
import numpy as np
from numpy.typing import NDArray

from companion.core.errors import InputError
from companion.core.messages import Array

GRAVITY_M_S2 = 9.80665
AIR_DENSITY_KG_M3 = 1.225
DEFAULT_FILE = Path(__file__).with_name("quad.toml")

Positive = Annotated[float, msgspec.Meta(gt=0)]
NotNegative = Annotated[float, msgspec.Meta(ge=0)]
Fraction = Annotated[float, msgspec.Meta(gt=0, le=1)]
Vec3 = tuple[float, float, float]
Four = tuple[float, float, float, float]


class Airframe(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Rigid body and its drag."""

    mass_kg: Positive
    inertia_kg_m2: tuple[Vec3, Vec3, Vec3]  # about the centre of mass, symmetric, rotors at rest included
    drag_area_m2: tuple[NotNegative, NotNegative, NotNegative]  # Cd*A per body axis


class Rotors(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Four rotors with axes along body +z."""

    xyz_m: tuple[Vec3, Vec3, Vec3, Vec3]  # hubs in the body frame
    turning: Four  # +1: about +z (counter-clockwise from above), -1: the other way
    radius_m: Positive
    thrust_n_s2: NotNegative  # T = k w^2
    torque_ratio_m: NotNegative  # Q = ratio * k w^2
    axial_n_s2_m: NotNegative  # loss of thrust per rotor speed and climb through the air
    translational_lift_n_s2_m2: NotNegative  # gain per square of the speed in the disc's plane
    drag_n_s2_m: NotNegative  # H-force per rotor speed and speed in the disc's plane
    inertia_kg_m2: NotNegative  # of one rotor about its axis
    ground_effect_radius_m: NotNegative


class Motor(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Command u in [0, 1] asks for u * speed_at_full * volts / full volts, with a lag."""

    time_constant_up_s: Positive
    time_constant_down_s: Positive
    speed_at_full_rad_s: Positive
    efficiency: Fraction


class Battery(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Open-circuit curve behind one resistance."""

    capacity_ah: Positive
    cells: Annotated[int, msgspec.Meta(ge=1)]
    resistance_ohm: NotNegative
    avionics_w: NotNegative
    cell_v: Annotated[tuple[Positive, ...], msgspec.Meta(min_length=11, max_length=11)]  # at 0, 10, ... 100 %


class Gear(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Four legs: springs on the ground with friction."""

    leg_xyz_m: tuple[Vec3, Vec3, Vec3, Vec3]
    stiffness_n_m: Positive
    damping_n_s_m: NotNegative
    friction: NotNegative
    touch_speed_max_m_s: Positive
    touch_tilt_max_deg: Annotated[float, msgspec.Meta(gt=0, lt=90)]


class Hull(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """What may not touch anything, besides the rotor discs."""

    sphere_xyz_r_m: tuple[Four, ...]


class VehicleParams(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """All figures of one aircraft."""

    airframe: Airframe
    rotors: Rotors
    motor: Motor
    battery: Battery
    gear: Gear
    hull: Hull

    @property
    def weight_n(self) -> float:
        """Weight, N."""
        return self.airframe.mass_kg * GRAVITY_M_S2

    @property
    def hover_speed_rad_s(self) -> float:
        """Rotor speed at which four rotors in still free air carry the weight; 0 without thrust."""
        k = self.rotors.thrust_n_s2
        return math.sqrt(self.weight_n / (4 * k)) if k > 0 else 0.0

    @property
    def hover_command(self) -> float:
        """Motor command of that speed on a full battery without load."""
        return self.hover_speed_rad_s / self.motor.speed_at_full_rad_s

    @property
    def max_rotor_thrust_n(self) -> float:
        """Static thrust of one rotor at full command on a full battery without load; goes with u^2."""
        return self.rotors.thrust_n_s2 * self.motor.speed_at_full_rad_s**2

    @property
    def standing_height_m(self) -> float:
        """Height of the body's origin above flat ground when it stands on its legs."""
        sink = self.weight_n / (4 * self.gear.stiffness_n_m)
        return -min(leg[2] for leg in self.gear.leg_xyz_m) - sink


def load_params(path: Path = DEFAULT_FILE) -> VehicleParams:
    """Read a vehicle file; raises InputError with file and key."""
    try:
        values = tomllib.loads(path.read_text(encoding="utf-8"))
        params = msgspec.convert(values, VehicleParams)
    except (OSError, tomllib.TOMLDecodeError, msgspec.ValidationError) as error:
        text, _, place = str(error).partition(" - at `$.")
        raise InputError(text, file=str(path), field=place.rstrip("`")) from None
    J = np.array(params.airframe.inertia_kg_m2)
    if not (np.allclose(J, J.T) and np.linalg.eigvalsh(J)[0] > 0):
        raise InputError(
            "is not an inertia",
            file=str(path),
            field="airframe.inertia_kg_m2",
            valid="symmetric, positive definite",
        )
    return params


# One record holds what the kernels need: a single argument, read by name.
MODEL = np.dtype(
    [
        ("mass", "f8"), ("J", "f8", (3, 3)), ("J_inverse", "f8", (3, 3)), ("drag", "f8", (3,)),
        ("hub", "f8", (4, 3)), ("turning", "f8", (4,)), ("k_thrust", "f8"), ("k_torque", "f8"),
        ("k_axial", "f8"), ("k_lift", "f8"), ("k_rotor_drag", "f8"), ("J_rotor", "f8"),
        ("ground_radius", "f8"), ("hover_speed", "f8"), ("tau_up", "f8"), ("tau_down", "f8"),
        ("full_speed", "f8"), ("efficiency", "f8"), ("capacity_c", "f8"), ("resistance", "f8"),
        ("avionics_w", "f8"), ("volts", "f8", (11,)), ("full_volts", "f8"), ("health", "f8", (4,)),
        ("leg", "f8", (4, 3)), ("k_leg", "f8"),
        ("c_leg", "f8"), ("friction", "f8"), ("touch_speed", "f8"), ("touch_cosine", "f8"),
    ]
)  # fmt: skip


def pack(params: VehicleParams) -> NDArray[np.void]:
    """The record (1,) of dtype MODEL for the kernels."""
    a, r, mo, b, g = params.airframe, params.rotors, params.motor, params.battery, params.gear
    J = np.array(a.inertia_kg_m2)
    model = np.zeros(1, MODEL)
    model[0] = (
        a.mass_kg, J, np.linalg.inv(J), 0.5 * AIR_DENSITY_KG_M3 * np.array(a.drag_area_m2),
        np.array(r.xyz_m), np.array(r.turning), r.thrust_n_s2, r.torque_ratio_m * r.thrust_n_s2,
        r.axial_n_s2_m, r.translational_lift_n_s2_m2, r.drag_n_s2_m, r.inertia_kg_m2,
        r.ground_effect_radius_m, max(params.hover_speed_rad_s, 1.0), mo.time_constant_up_s,
        mo.time_constant_down_s, mo.speed_at_full_rad_s, mo.efficiency, 3600.0 * b.capacity_ah,
        b.resistance_ohm, b.avionics_w, b.cells * np.array(b.cell_v), b.cells * b.cell_v[-1], np.ones(4),
        np.array(g.leg_xyz_m),
        g.stiffness_n_m, g.damping_n_s_m, g.friction, g.touch_speed_max_m_s,
        math.cos(math.radians(g.touch_tilt_max_deg)),
    )  # fmt: skip
    return model


def hull_spheres(params: VehicleParams) -> Array:
    """Hull (N, 5): centre in the body frame, radius, m, and 1 where the sphere stands for a disc."""
    body = [(*s, 0.0) for s in params.hull.sphere_xyz_r_m]
    discs = [(*hub, params.rotors.radius_m, 1.0) for hub in params.rotors.xyz_m]
    return np.array(discs + body)
