"""Arming, modes and failsafes, with PX4's rules; every refusal and every failsafe is said in a text.

Source: PX4 user guide, "Safety configuration" and "Offboard mode".
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Final

import numpy as np

from companion.core.messages import Array
from sim.autopilot.control import Controller
from sim.autopilot.estimator import NEVER, Estimator
from sim.autopilot.flight import IDLE_COMMAND, Flight, Phase, wants_up
from sim.autopilot.frames import euler_from_quaternion
from sim.autopilot.guidance import Guidance
from sim.autopilot.modes import Mode, Result, Severity
from sim.autopilot.params import Parameters
from sim.autopilot.setpoint import SIZE, YAW, YAW_RATE, V, complete, stop

NS: Final = 1_000_000_000
STREAM_NS: Final = NS // 2  # OFFBOARD needs a setpoint this fresh
FORCE: Final = 21196  # the number that makes MAV_CMD_COMPONENT_ARM_DISARM skip the checks
MAX_ARMING_TILT: Final = math.radians(60)
LIFTING: Final = (Mode.TAKEOFF, Mode.MISSION)  # climb at first if they begin on the ground
Say = Callable[[Severity, str], None]


class Commander:
    """The vehicle's state: armed or not, mode, failsafe. One step per 10 ms by `tick`."""

    def __init__(self, parameters: Parameters, estimator: Estimator, controller: Controller, *, say: Say) -> None:
        self._parameters, self._estimator, self._controller, self._say = (
            parameters,
            estimator,
            controller,
            say,
        )
        self.guidance = Guidance(parameters)
        self.flight = Flight(parameters, estimator, controller)
        self.armed = False
        self.mode = Mode.HOLD
        self.failsafe = ""
        self.home = np.zeros(3)
        self.home_set = False
        self.battery = 1.0
        self.setpoint_ns = NEVER
        self._setpoint = np.full(SIZE, np.nan)
        self.demand = self._setpoint  # what is flown now, NED (11,)
        self.sticks = np.zeros(4)  # forward, right, up, yaw to the right: -1..1
        self.sticks_ns = NEVER
        self._climb_m = math.nan
        self.mission_ready: Callable[[], bool] = lambda: False  # a mission is stored
        self._battery_warned = 0
        self.now_ns = 0

    @property
    def position(self) -> Array:
        """Estimated p_ned, m, (3,)."""
        return self._estimator.p

    @property
    def heading(self) -> float:
        """Estimated yaw from north, clockwise, rad."""
        return euler_from_quaternion(self._estimator.q)[2]

    # --- requests -----------------------------------------------------------------

    def refusals(self, now_ns: int) -> list[str]:
        """Why it would not arm now; empty: it would."""
        e = self._estimator
        reasons = []
        if not e.attitude_valid:
            return ["Preflight Fail: attitude not aligned"]
        roll, pitch, _ = euler_from_quaternion(e.q)
        if math.acos(max(-1.0, math.cos(roll) * math.cos(pitch))) > MAX_ARMING_TILT:
            reasons.append("Preflight Fail: not upright")
        if not e.xy_valid:
            reasons.append("Preflight Fail: no valid local position estimate")
        if not e.z_valid:
            reasons.append("Preflight Fail: height estimate not stable")
        if self.battery < self._parameters["BAT_CRIT_THR"]:
            reasons.append("Preflight Fail: battery critical")
        if self.mode is Mode.OFFBOARD and now_ns - self.setpoint_ns > self._loss_ns():
            reasons.append("Preflight Fail: no offboard signal")
        return reasons

    def arm(self, now_ns: int, *, force: bool = False) -> Result:
        """Start the motors if the checks pass."""
        if self.armed:
            return Result.ACCEPTED
        reasons = [] if force else self.refusals(now_ns)
        if self.mode.lands or self.mode is Mode.RETURN:
            reasons.append(f"Arming denied: in mode {self.mode.value[2]}")
        for reason in reasons:
            self._say(Severity.CRITICAL, reason)
        if reasons:
            return Result.TEMPORARILY_REJECTED
        self.armed, self.failsafe = True, ""
        self.set_home(self._estimator.p)
        self.home_set = self._estimator.xy_valid
        self.flight.arm()
        self._say(Severity.INFO, "Armed by external command")
        return Result.ACCEPTED

    def disarm(self, *, force: bool = False, why: str = "external command") -> Result:
        """Stop the motors; in the air only by force."""
        if self.armed and not self.flight.landed and not force:
            self._say(Severity.CRITICAL, "Disarming denied! Not landed")
            return Result.DENIED
        if self.armed:
            self._say(Severity.INFO, f"Disarmed by {why}")
        self.armed, self.failsafe = False, ""
        self.flight.phase, self.flight.landed = Phase.GROUND, True
        self._controller.reset()
        if self.mode is not Mode.OFFBOARD:
            self.mode = Mode.HOLD
        return Result.ACCEPTED

    def set_mode(self, now_ns: int, mode: Mode) -> Result:
        """Change the mode as the user asks, or refuse with a reason."""
        problem = self._mode_problem(now_ns, mode)
        if problem:
            self._say(Severity.CRITICAL, f"Switching to {mode.value[2]} denied: {problem}")
            return Result.DENIED if mode in (Mode.OFFBOARD, Mode.MISSION) else Result.TEMPORARILY_REJECTED
        self.failsafe = ""
        self._enter(mode)
        return Result.ACCEPTED

    def take_off(self, now_ns: int, climb_m: float = math.nan) -> Result:
        """Climb from here by `climb_m` (NaN: MIS_TAKEOFF_ALT), once armed."""
        if not self.flight.landed:
            self._say(Severity.CRITICAL, "Takeoff denied: already in the air")
            return Result.DENIED
        least = self._parameters["MIS_TAKEOFF_ALT"]
        if climb_m < least - 0.1:
            self._say(Severity.CRITICAL, f"Using minimum takeoff altitude: {least:.2f} m")
        self._climb_m = max(climb_m, least) if math.isfinite(climb_m) else math.nan
        return self.set_mode(now_ns, Mode.TAKEOFF)

    def climb_to(self, climb_m: float) -> None:
        """How far a mission that begins on the ground climbs first (NaN: MIS_TAKEOFF_ALT)."""
        self._climb_m = climb_m

    def reposition(self, now_ns: int, target: Array, yaw: float) -> Result:
        """Fly to a place (NED, NaN: stay) in HOLD."""
        if not self.armed or self.flight.landed:
            return Result.DENIED
        result = self.set_mode(now_ns, Mode.HOLD)
        if result is Result.ACCEPTED:
            self.guidance.go(target, yaw)
        return result

    def brake(self) -> None:
        """Stop here, in the mode that is on."""
        self.guidance.start(self.mode, self._estimator, self.heading)

    def set_home(self, p_ned: Array) -> None:
        """Where RETURN leads."""
        self.home[:], self.home_set = p_ned, True

    def accept_setpoint(self, now_ns: int, setpoint: Array) -> None:
        """A setpoint of the offboard stream, NED (11,)."""
        self._setpoint, self.setpoint_ns = setpoint, now_ns

    def accept_sticks(self, now_ns: int, sticks: Array) -> None:
        """The pilot's sticks, -1..1: forward, right, up, yaw to the right."""
        self.sticks[:], self.sticks_ns = sticks, now_ns

    # --- the 100 Hz step ------------------------------------------------------------

    def tick(self, now_ns: int, dt: float) -> None:
        """Failsafes, phase of flight, position loop."""
        if not self.armed:
            return
        self._check_failsafes(now_ns)
        if self.flight.phase is Phase.GROUND:
            self._on_ground(now_ns, dt)
        else:
            self._choose_demand(dt)
            self.flight.fly(self.demand, dt)
            if self.mode is Mode.TAKEOFF and self.arrived():
                top = self.guidance.target.copy()
                self._enter(Mode.HOLD)
                self.guidance.go(top, math.nan)

    def motors(self, dt: float) -> Array:
        """Commands of this instant, (4,)."""
        if not self.armed:
            return self._controller.idle(0.0)
        if self.flight.phase is Phase.GROUND:
            return self._controller.idle(IDLE_COMMAND)
        return self._controller.rates(self._estimator.q, self._estimator.omega, dt)

    def _on_ground(self, now_ns: int, dt: float) -> None:
        self.flight.wait(dt)
        flown = self.flight.has_flown
        patience = self._parameters["COM_DISARM_LAND" if flown else "COM_DISARM_PRFLT"]
        if patience > 0 and self.flight.on_ground_s > patience:
            self.disarm(why="landing" if flown else "auto preflight disarming")
        elif self.flight.ready_to_lift and self._estimator.xy_valid and self._wants_to_lift(now_ns):
            if self.mode in LIFTING:
                yaw = self.heading
                self.guidance.start(Mode.TAKEOFF, self._estimator, yaw, climb_m=self._climb())
            self._say(Severity.INFO, "Takeoff detected")
            self.flight.lift()

    def _wants_to_lift(self, now_ns: int) -> bool:
        if self.mode is Mode.OFFBOARD:
            fresh = now_ns - self.setpoint_ns <= self._loss_ns()
            return fresh and wants_up(self._setpoint, self._estimator.p)
        if self.mode is Mode.POSCTL:
            return bool(self.sticks[2] > 0.15)
        return self.mode is Mode.TAKEOFF or (self.mode is Mode.MISSION and not self.flight.has_flown)

    def arrived(self) -> bool:
        """At the place that the guidance leads to, and slow."""
        return self.guidance.arrived(self._estimator, self._parameters["NAV_MC_ALT_RAD"])

    def _choose_demand(self, dt: float) -> None:
        if self.mode is Mode.OFFBOARD:
            self.demand = self._setpoint if complete(self._setpoint) else stop()
        elif self.mode is Mode.POSCTL:
            self.demand = self._stick_demand()
        else:
            self.demand = self.guidance.update(self.mode, self._estimator, self.home, dt)

    def _stick_demand(self) -> Array:
        p, demand = self._parameters, np.full(SIZE, np.nan)
        yaw = self.heading
        forward, right, up, turn = self.sticks
        c, s, top = math.cos(yaw), math.sin(yaw), p["MPC_VEL_MANUAL"]
        climb = up * p["MPC_Z_VEL_MAX_UP"] if up > 0 else up * p["MPC_Z_VEL_MAX_DN"]
        demand[V] = top * (c * forward - s * right), top * (s * forward + c * right), -climb
        demand[YAW], demand[YAW_RATE] = np.nan, turn * math.radians(p["MPC_MAN_Y_MAX"])
        return demand

    # --- failsafes -------------------------------------------------------------------

    def _check_failsafes(self, now_ns: int) -> None:
        blind = not self._estimator.xy_valid
        if blind and not self.flight.landed and self.mode is not Mode.DESCEND:
            self._fail(Mode.DESCEND, "position estimate lost, descending")
        if self.mode is Mode.OFFBOARD and now_ns - self.setpoint_ns > self._loss_ns():
            self._offboard_lost(now_ns)
        if self.mode is Mode.POSCTL and now_ns - self.sticks_ns > self._parameters["COM_RC_LOSS_T"] * NS:
            self._fail(Mode.HOLD, "manual control lost")
        self._check_battery()

    def _offboard_lost(self, now_ns: int) -> None:
        """COM_OBL_RC_ACT: 0-2 the pilot (without one: return), 3 return, 4 land, 5 hold, 7 disarm."""
        action = self._parameters.integer("COM_OBL_RC_ACT")
        pilot = now_ns - self.sticks_ns <= self._parameters["COM_RC_LOSS_T"] * NS
        if action == 7:
            self.disarm(force=True, why="offboard loss")
            self.mode = Mode.HOLD
            return
        modes = {3: Mode.RETURN, 4: Mode.LAND, 5: Mode.HOLD}
        self._fail(modes.get(action, Mode.POSCTL if pilot else Mode.RETURN), "offboard signal lost")

    def _check_battery(self) -> None:
        p = self._parameters
        level = 2 if self.battery < p["BAT_CRIT_THR"] else 1 if self.battery < p["BAT_LOW_THR"] else 0
        if level <= self._battery_warned:
            return
        self._battery_warned = level
        self._say(Severity.CRITICAL, "Critical battery" if level == 2 else "Low battery level")
        if level == 2 and p.integer("COM_LOW_BAT_ACT") >= 2 and not self.flight.landed and not self.mode.lands:
            act = Mode.RETURN if p.integer("COM_LOW_BAT_ACT") == 3 else Mode.LAND
            self._fail(act, "battery critical")

    def _fail(self, mode: Mode, why: str) -> None:
        self.failsafe = why
        self._say(Severity.CRITICAL, f"Failsafe: {why}")
        self._enter(mode)

    # --- modes ------------------------------------------------------------------------

    def _mode_problem(self, now_ns: int, mode: Mode) -> str:
        if mode is Mode.MISSION and not self.mission_ready():
            return "no valid mission"
        if mode is Mode.MANUAL:
            return "no remote control is built in"
        if mode is Mode.OFFBOARD and now_ns - self.setpoint_ns > STREAM_NS:
            return "no offboard signal"
        if mode is Mode.POSCTL and now_ns - self.sticks_ns > self._parameters["COM_RC_LOSS_T"] * NS:
            return "no manual control"
        if self.armed and not self._estimator.xy_valid:
            return "no valid position estimate"
        if mode is Mode.RETURN and not self.home_set:
            return "no home position"
        return ""

    def _enter(self, mode: Mode) -> None:
        if mode is self.mode and mode in (Mode.TAKEOFF, Mode.LAND, Mode.RETURN, Mode.MISSION):
            return
        self.mode = mode
        if mode.automatic:
            self.guidance.start(mode, self._estimator, self.heading, climb_m=self._climb())
            if mode is Mode.RETURN:
                self.guidance.returning(self._estimator, self.home)

    def _climb(self) -> float:
        return self._climb_m if math.isfinite(self._climb_m) else self._parameters["MIS_TAKEOFF_ALT"]

    def _loss_ns(self) -> int:
        return int(self._parameters["COM_OF_LOSS_T"] * NS)
