"""A sweep deskewed without an IMU: by the motion that led to it from the node before."""

from __future__ import annotations

from companion.core.geometry import exp_so3, log_so3
from companion.core.messages import Array, Array32
from companion.estimation.deskew import ScanGate, constant_twist_nodes, deskew_points
from companion.estimation.state import State


def twist_between(before: State, after: State, seconds: float) -> tuple[Array, Array]:
    """Constant body twist from one pose to another: turn rate in rad/s (3,), velocity in m/s (3,)."""
    turn = log_so3(before.R.T @ after.R)
    return turn / seconds, (before.R @ exp_so3(turn / 2)).T @ (after.p - before.p) / seconds


def deskewed_by_twist(
    sweep: tuple[Array32, Array32], twist: tuple[Array, Array], at: State, mount: tuple[Array, Array], gate: ScanGate
) -> Array32:
    """`sweep` = points (N, 3) in the sensor frame, and their ages in s, to the body frame of its end, where `at` is."""
    R, p = at.R.copy(), at.p.copy()
    nodes = constant_twist_nodes(R, p, *twist, t_end_s=0.0, duration_s=gate.max_age_s)
    return deskew_points(*sweep, nodes, pose_end=(R, p), t_end_s=0.0, mount=mount, gate=gate)
