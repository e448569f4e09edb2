"""What the mission looks at, and two questions about it: may it start, and is it still ours?"""

from __future__ import annotations

from dataclasses import dataclass

from companion.core.messages import Odometry, PlanStatus, SafetyStatus, SmoothedState, VehicleStatus


@dataclass(slots=True)
class Inputs:
    """The newest of everything."""

    odometry: Odometry | None = None
    vehicle: VehicleStatus | None = None
    plan: PlanStatus | None = None
    safety: SafetyStatus | None = None
    smoothed: SmoothedState | None = None


def missing(inputs: Inputs, now_ns: int, *, fresh_s: float) -> str:
    """What a start still waits for; '' if nothing."""
    odometry, vehicle, safety = inputs.odometry, inputs.vehicle, inputs.safety
    if vehicle is None or not vehicle.connected:
        return _because("no vehicle", vehicle)
    if odometry is None or now_ns - odometry.stamp_ns > fresh_s * 1e9:
        return "no odometry"
    if not vehicle.landed:
        return "the vehicle is in the air already"
    if vehicle.armed:
        return f"armed by somebody else, in mode {vehicle.mode}"
    if not vehicle.ready:
        return _because("the autopilot is not ready", vehicle)
    if safety is not None and safety.action in ("hold", "land"):
        return safety.reason
    return ""


def _because(what: str, vehicle: VehicleStatus | None) -> str:
    return f"{what}: {vehicle.text}" if vehicle is not None and vehicle.text else what


def taken_over(vehicle: VehicleStatus | None, ours: tuple[str, ...], *, may_disarm: bool) -> str:
    """Why this flight is no longer ours; '' if it is. `ours`: the modes that we asked for."""
    if vehicle is None:
        return ""
    if not vehicle.armed:
        where = "on the ground" if vehicle.landed else "in flight"
        return "" if may_disarm else f"disarmed {where}"
    return "" if vehicle.mode in ours else f"pilot took over: mode {vehicle.mode}, not {ours[0]}"
