"""From the ground into the air and back: spool-up, take-off ramp, flight, land detector.

Runs at 100 Hz between the modes (which say what to fly) and the cascade (which flies it).
Source: PX4 user guide, "Takeoff" and "Land Detector Configuration".
"""

from __future__ import annotations

import math
from enum import Enum
from typing import Final

import numpy as np

from companion.core.messages import Array
from sim.autopilot.control import Controller
from sim.autopilot.estimator import Estimator
from sim.autopilot.params import Parameters
from sim.autopilot.setpoint import SIZE, A, P, V

GRAVITY: Final = 9.80665
IDLE_COMMAND: Final = 0.08  # armed on the ground: rotors just turn
CONTACT_S: Final = 0.35
LANDED_S: Final = 1.0
CLEAR_M: Final = 0.2  # height at which the legs are free


class Phase(Enum):
    """Where in a flight the vehicle is."""

    GROUND = "ground"
    RAMP = "ramp"  # thrust rises until it lifts
    FLIGHT = "flight"


class LandDetector:
    """Ground contact: it wants down and does not move; landed: low thrust and at rest for a second."""

    def __init__(self, parameters: Parameters) -> None:
        self._parameters = parameters
        self._contact_s = self._landed_s = 0.0

    @property
    def contact(self) -> bool:
        """The ground holds the vehicle up."""
        return self._contact_s >= CONTACT_S

    @property
    def landed(self) -> bool:
        """It rests on the ground."""
        return self._landed_s >= LANDED_S

    def reset(self) -> None:
        """In the air again."""
        self._contact_s = self._landed_s = 0.0

    def update(self, estimator: Estimator, controller: Controller, dt: float) -> None:
        """One step of `dt` seconds."""
        p, v = self._parameters, estimator.v
        least = p["MPC_THR_MIN"]
        low = controller.thrust <= least + 0.3 * (controller.hover_thrust - least)
        wants_down = controller.descent_setpoint > 0.2 and controller.thrust < 0.95 * controller.hover_thrust
        near = not estimator.range_m > 0.6  # NaN: nothing seen, so it may be
        still = abs(v[2]) < p["LNDMC_Z_VEL_MAX"]
        self._contact_s = self._contact_s + dt if still and near and (low or wants_down) else 0.0
        turning = float(np.abs(estimator.omega).max()) > math.radians(p["LNDMC_ROT_MAX"])
        moving = estimator.xy_valid and math.hypot(v[0], v[1]) > p["LNDMC_XY_VEL_MAX"]
        rests = self.contact and low and not turning and not moving
        self._landed_s = self._landed_s + dt if rests else 0.0


class Flight:
    """Phases of flight and the position loop; `armed` comes from the commander."""

    def __init__(self, parameters: Parameters, estimator: Estimator, controller: Controller) -> None:
        self._parameters, self._estimator, self._controller = parameters, estimator, controller
        self.detector = LandDetector(parameters)
        self.phase = Phase.GROUND
        self.landed = True
        self.has_flown = False
        self._since_arming_s = self._ramp_s = 0.0
        self.on_ground_s = 0.0
        self._ground_z = 0.0
        self._limits, self._level = np.zeros(3), np.zeros(SIZE)
        self._touchdown = np.full(SIZE, np.nan)
        self._touchdown[A] = 0.0, 0.0, 100.0  # PX4's own way to say: no thrust

    def arm(self) -> None:
        """Motors start; the spool-up time begins."""
        self.phase, self.landed, self.has_flown = Phase.GROUND, True, False
        self._since_arming_s = self.on_ground_s = 0.0
        self.detector.reset()

    @property
    def ready_to_lift(self) -> bool:
        """Spooled up and on the ground."""
        return self.phase is Phase.GROUND and self._since_arming_s >= self._parameters["COM_SPOOLUP_TIME"]

    def lift(self) -> None:
        """Begin the take-off ramp."""
        self.phase, self._ramp_s, self._ground_z = Phase.RAMP, 0.0, float(self._estimator.p[2])
        self._controller.reset()
        self.detector.reset()

    def wait(self, dt: float) -> None:
        """Armed on the ground without a wish to fly."""
        self._since_arming_s += dt
        self.on_ground_s += dt

    def fly(self, setpoint: Array, dt: float) -> None:
        """One position step in the air or on the ramp; notices the landing."""
        p = self._parameters
        if self.phase is Phase.RAMP:
            self._ramp_s += dt
            if self._ramp_s >= p["MPC_TKO_RAMP_T"]:
                self.phase = Phase.FLIGHT
        contact = self.phase is Phase.FLIGHT and self.detector.contact
        self._limits[:] = self._climb_limit(), self._tilt_limit(contact), self._integrators(contact)
        demand = self._touchdown if contact else self._straight_up(setpoint)
        e = self._estimator
        self._controller.position(demand, e.x, e.acceleration, self._limits, dt)
        if self.landed and self._controller.thrust > 0.7 * self._controller.hover_thrust:
            self.landed, self.has_flown = False, True
        if self.phase is Phase.FLIGHT:
            self._notice_landing(setpoint, contact, dt)

    def _straight_up(self, setpoint: Array) -> Array:
        """The setpoint; without its horizontal part until the legs are off the ground, or it would tip over."""
        risen = self._ground_z - self._estimator.p[2] > CLEAR_M
        if risen or self.phase is Phase.FLIGHT:
            self._ground_z = math.inf
            return setpoint
        self._level[:] = setpoint
        self._level[[0, 1, 3, 4]] = np.nan
        self._level[[6, 7]] = 0.0
        self._controller.forget_rates()
        return self._level

    def _notice_landing(self, setpoint: Array, contact: bool, dt: float) -> None:
        if contact and wants_up(setpoint, self._estimator.p):
            self.detector.reset()
            return
        self.detector.update(self._estimator, self._controller, dt)
        if self.detector.landed:
            self.phase, self.landed = Phase.GROUND, True
            self.on_ground_s = 0.0
            self._controller.reset()

    def _integrators(self, contact: bool) -> float:
        return 0.0 if contact else 2.0 if self.phase is Phase.FLIGHT else 1.0

    def _climb_limit(self) -> float:
        """On the ramp it rises from the speed that cancels the weight's thrust to the usual one."""
        top = self._parameters["MPC_Z_VEL_MAX_UP"]
        if self.phase is Phase.FLIGHT:
            return top
        start = -GRAVITY / self._parameters["MPC_Z_VEL_P_ACC"]
        share = min(self._ramp_s / max(self._parameters["MPC_TKO_RAMP_T"], 1e-3), 1.0)
        return start + share * (top - start)

    def _tilt_limit(self, contact: bool) -> float:
        low = contact or self.landed
        return math.radians(self._parameters["MPC_TILTMAX_LND" if low else "MPC_TILTMAX_AIR"])


def wants_up(setpoint: Array, p: Array) -> bool:
    """Whether a setpoint leads off the ground; NaN components do not."""
    down = setpoint[P.start + 2], setpoint[V.start + 2], setpoint[A.start + 2]
    return bool(down[0] < p[2] - 0.1 or down[1] < -0.1 or down[2] < -0.5)
