"""Cascaded control in PX4's structure: position P, velocity PID, attitude P, rate PID, mixer.

Everything is NED/FRD; thrust and torques are normalised: thrust 1 is all four rotors at
full thrust, torque 1 the largest torque about an axis from zero mean. Sources: PX4 user
guide, "Multicopter controller diagrams"; D. Brescianini, M. Hehn, R. D'Andrea, "Nonlinear
quadrocopter attitude control", ETH 2013 (reduced attitude first, then heading).
"""

from __future__ import annotations

import math

import numpy as np

from companion.core.messages import Array
from sim.autopilot import cascade
from sim.autopilot.allocation import allocation
from sim.autopilot.params import Parameters
from sim.autopilot.readings import Airframe


class Controller:
    """From setpoint and estimate to motor commands; position at 100 Hz, attitude and rates at 400 Hz."""

    def __init__(self, parameters: Parameters, airframe: Airframe) -> None:
        self._parameters = parameters
        self._mixer, _ = allocation(airframe)
        self._version, self._dt = -1, 0.0
        self._gains, self._rate_gains = np.zeros(cascade.GAINS), np.zeros(cascade.RATE_GAINS)
        self.velocity_integral = np.zeros(3)
        self.attitude_setpoint = np.array([1.0, 0.0, 0.0, 0.0])
        self.rate_setpoint = np.zeros(3)
        self._out = np.zeros(cascade.OUT)  # thrust, yaw rate, hover thrust, vertical velocity setpoint
        self._out[cascade.HOVER] = parameters["MPC_THR_HOVER"]
        self._rate_state = np.zeros(cascade.RATE_STATE)
        self.motors = np.zeros(4)

    @property
    def thrust(self) -> float:
        """Collective thrust asked for, 0..1."""
        return float(self._out[cascade.THRUST])

    @property
    def hover_thrust(self) -> float:
        """Thrust that carries the weight, learnt in flight if MPC_USE_HTE is set."""
        return float(self._out[cascade.HOVER])

    @property
    def descent_setpoint(self) -> float:
        """Vertical velocity asked for after all limits, down positive, m/s."""
        return float(self._out[cascade.V_DOWN])

    def reset(self) -> None:
        """Forget the integrators: before a take-off and when the mode's demands jump."""
        self.velocity_integral[:] = 0.0
        self.forget_rates()

    def forget_rates(self) -> None:
        """Forget the rate integrators: on sloping ground they would wind up against the legs."""
        self._rate_state[cascade.INTEGRAL : cascade.INTEGRAL + 3] = 0.0

    def position(self, setpoint: Array, state: Array, acceleration: Array, limits: Array, dt: float) -> None:
        """Velocity and thrust vector. `setpoint` (11,): p, v, a, yaw, yaw rate with NaN for "not controlled".

        `state` is the estimator's (16,), `limits` (3,): climb m/s, tilt rad, and 0: integrators off,
        1: on, 2: hover thrust is learnt, too.
        """
        self._refresh(self._dt)
        cascade.position_step(
            setpoint, state, acceleration, limits, dt, self._gains,
            self.velocity_integral, self.attitude_setpoint, self._out,
        )  # fmt: skip

    def idle(self, command: float) -> Array:
        """Motors at one command: spinning on the ground, or stopped."""
        self._out[cascade.THRUST] = 0.0
        self.motors[:] = command
        return self.motors

    def rates(self, q: Array, omega: Array, dt: float) -> Array:
        """Attitude and rate loops and the mixer: motor commands, (4,)."""
        self._refresh(dt)
        cascade.rate_step(
            q, omega, self.attitude_setpoint, self._out, self._rate_gains, self._mixer,
            self._rate_state, self.rate_setpoint, self.motors,
        )  # fmt: skip
        return self.motors

    def _refresh(self, dt: float) -> None:
        if self._version == self._parameters.version and self._dt == dt:
            return
        p = self._parameters
        self._gains[:] = (
            p["MPC_XY_P"], p["MPC_Z_P"], p["MPC_XY_VEL_P_ACC"], p["MPC_XY_VEL_I_ACC"], p["MPC_XY_VEL_D_ACC"],
            p["MPC_Z_VEL_P_ACC"], p["MPC_Z_VEL_I_ACC"], p["MPC_Z_VEL_D_ACC"], p["MPC_XY_VEL_MAX"],
            p["MPC_Z_VEL_MAX_DN"], p["MPC_THR_MIN"], p["MPC_THR_MAX"], p["MPC_THR_XY_MARG"],
            p["MPC_ACC_DECOUPLE"], p["MPC_USE_HTE"],
        )  # fmt: skip
        axes = ("ROLL", "PITCH", "YAW")
        rate = [[p[f"MC_{a}RATE_{k}"] for a in axes] for k in ("P", "I", "D")]
        limit = [p[f"MC_{a}_INT_LIM"] for a in ("RR", "PR", "YR")]
        top = [math.radians(p[f"MC_{a}RATE_MAX"]) for a in axes]
        attitude = [p[f"MC_{a}_P"] for a in axes]
        smooth = [_low_pass(p["IMU_GYRO_CUTOFF"], dt), _low_pass(p["IMU_DGYRO_CUTOFF"], dt)]
        self._rate_gains[:] = [
            *attitude, p["MC_YAW_WEIGHT"], *rate[0], *rate[1], *rate[2], *limit, *top, *smooth, dt,
            p["THR_MDL_FAC"],
        ]  # fmt: skip
        self._version, self._dt = p.version, dt


def _low_pass(cutoff_hz: float, dt: float) -> float:
    """Gain per step of a first-order low-pass."""
    return 1.0 - math.exp(-2 * math.pi * cutoff_hz * dt)
