"""From torques and thrust to the four rotors: the mixer of one airframe."""

from __future__ import annotations

import numpy as np

from companion.core.messages import Array
from sim.autopilot.readings import Airframe


def allocation(airframe: Airframe) -> tuple[Array, Array]:
    """Mixer (4 rotors, roll pitch yaw thrust) and the torque in N m of each unit torque command, (3,)."""
    x, y = airframe.rotor_xy_m[:, 0], airframe.rotor_xy_m[:, 1]
    yaw = airframe.rotor_spin * airframe.torque_per_thrust_m  # the reaction turns against the rotor
    effect = np.array([y, x, yaw, np.ones(4)]) * airframe.max_thrust_n  # FRD torques and force
    mixer = np.linalg.inv(effect)
    peak = np.abs(mixer).max(axis=0)
    return mixer / peak, 1.0 / peak[:3]
