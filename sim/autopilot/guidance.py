"""What the autopilot flies by itself: hold, go to a place, take off, land, return.

A point glides from the vehicle to the target within the limits of speed and acceleration;
the cascade follows it with position and velocity.
"""

from __future__ import annotations

import math

import numpy as np

from companion.core.messages import Array
from sim.autopilot.estimator import Estimator
from sim.autopilot.modes import Mode
from sim.autopilot.params import Parameters
from sim.autopilot.setpoint import SIZE, YAW, YAW_RATE, A, P, V


class Guidance:
    """Setpoints of the automatic modes; `target` (NED, m) is where the point glides to."""

    def __init__(self, parameters: Parameters) -> None:
        self._parameters = parameters
        self.target = np.zeros(3)
        self.setpoint = np.full(SIZE, np.nan)
        self._point, self._speed = np.zeros(3), np.zeros(3)
        self._yaw = self._yaw_target = 0.0
        self.cruise = math.nan  # m/s by MAV_CMD_DO_CHANGE_SPEED; NaN: MPC_XY_CRUISE
        self.landing = False  # the last leg of a return, too

    def start(self, mode: Mode, estimator: Estimator, yaw: float, *, climb_m: float = 0.0) -> None:
        """Enter a mode at the vehicle's place and speed; `climb_m` is the height of a take-off."""
        self._point[:], self._speed[:] = estimator.p, estimator.v
        self._yaw = self._yaw_target = yaw
        self.landing = mode.lands
        braking = self._parameters["MPC_ACC_HOR"]
        speed = math.hypot(estimator.v[0], estimator.v[1])
        self.target[:] = estimator.p
        if mode is Mode.TAKEOFF:
            self.target[2] -= climb_m
            self._speed[:] = 0.0
            return
        self.target[:2] += estimator.v[:2] * speed / (2 * braking)
        self.target[2] += estimator.v[2] * abs(estimator.v[2]) / 4.0

    def go(self, target: Array, yaw: float) -> None:
        """Glide to a place (NED); NaN components and a NaN yaw stay."""
        keep = np.isnan(target)
        self.target[:] = np.where(keep, self.target, target)
        if math.isfinite(yaw):
            self._yaw_target = yaw

    def returning(self, estimator: Estimator, home: Array) -> None:
        """Plan a return: climb first unless home is near, then fly over it, then land."""
        p = self._parameters
        if math.hypot(*(estimator.p[:2] - home[:2])) < p["RTL_MIN_DIST"]:
            self.target[:2] = home[:2]
        else:
            self.target[2] = min(float(estimator.p[2]), home[2] - p["RTL_RETURN_ALT"])

    def update(self, mode: Mode, estimator: Estimator, home: Array, dt: float) -> Array:
        """Advance the point and return the setpoint (11,)."""
        if mode is Mode.RETURN:
            self._return_leg(estimator, home)
        sp = self.setpoint
        sp[A] = np.nan
        turn = math.radians(self._parameters["MPC_YAWRAUTO_MAX"]) * dt
        left = math.remainder(self._yaw_target - self._yaw, 2 * math.pi)
        self._yaw += min(max(left, -turn), turn)
        sp[YAW], sp[YAW_RATE] = self._yaw, np.nan
        if mode is Mode.DESCEND:
            sp[P] = sp[V] = np.nan
            sp[V.start + 2] = self._parameters["MPC_LAND_SPEED"]
            return sp
        self._glide_horizontally(estimator, dt)
        if self.landing:
            self._speed[2] = self._descent(estimator, home)
            self._point[2] = estimator.p[2]
        else:
            self._glide_vertically(mode, estimator, dt)
        sp[P], sp[V] = self._point, self._speed
        if self.landing:
            sp[P.start + 2] = np.nan
        return sp

    def arrived(self, estimator: Estimator, radius_m: float) -> bool:
        """Whether the vehicle is within `radius_m` of the target and slow."""
        gap = np.linalg.norm(estimator.p - self.target)
        return bool(gap < radius_m and np.abs(estimator.v).max() < 0.5)

    def _return_leg(self, estimator: Estimator, home: Array) -> None:
        high_enough = abs(estimator.p[2] - self.target[2]) < 0.5
        away = math.hypot(*(estimator.p[:2] - home[:2]))
        if high_enough and not self.landing:
            self.target[:2] = home[:2]
            if away < 0.5 and math.hypot(*estimator.v[:2]) < 0.5:
                self.landing = True

    def _descent(self, estimator: Estimator, home: Array) -> float:
        """Speed down, m/s: slower near the ground, crawling at last if the range finder sees it."""
        p = self._parameters
        seen = math.isfinite(estimator.range_m)
        height = estimator.range_m if seen else home[2] - float(estimator.p[2])
        if seen and height < p["MPC_LAND_ALT3"]:
            return p["MPC_LAND_CRWL"]
        low, high = p["MPC_LAND_ALT2"], max(p["MPC_LAND_ALT1"], p["MPC_LAND_ALT2"] + 0.1)
        share = min(max((height - low) / (high - low), 0.0), 1.0)
        return p["MPC_LAND_SPEED"] + share * (p["MPC_Z_V_AUTO_DN"] - p["MPC_LAND_SPEED"])

    def _glide_horizontally(self, estimator: Estimator, dt: float) -> None:
        p = self._parameters
        dx, dy = (self.target[:2] - self._point[:2]).tolist()
        gap = math.hypot(dx, dy)
        lag = math.hypot(*(self._point[:2] - estimator.p[:2]))
        cruise = self.cruise if math.isfinite(self.cruise) else p["MPC_XY_CRUISE"]
        top = min(cruise, p["MPC_XY_VEL_MAX"])
        speed = _approach(gap, top, p["MPC_ACC_HOR"]) if lag < p["MPC_XY_ERR_MAX"] else 0.0
        want_x, want_y = (dx / gap * speed, dy / gap * speed) if gap > 1e-6 else (0.0, 0.0)
        change_x, change_y = want_x - self._speed[0], want_y - self._speed[1]
        change = math.hypot(change_x, change_y)
        share = min(1.0, p["MPC_ACC_HOR"] * dt / change) if change > 1e-9 else 1.0
        self._speed[0] += share * change_x
        self._speed[1] += share * change_y
        self._point[:2] += self._speed[:2] * dt

    def _glide_vertically(self, mode: Mode, estimator: Estimator, dt: float) -> None:
        p = self._parameters
        gap = float(self.target[2] - self._point[2])
        up = p["MPC_TKO_SPEED"] if mode is Mode.TAKEOFF else p["MPC_Z_V_AUTO_UP"]
        top, accel = (up, p["MPC_ACC_UP_MAX"]) if gap < 0 else (p["MPC_Z_V_AUTO_DN"], p["MPC_ACC_DOWN_MAX"])
        held = abs(self._point[2] - estimator.p[2]) > 1.0
        want = 0.0 if held else math.copysign(_approach(abs(gap), top, accel), gap)
        self._speed[2] += min(max(want - self._speed[2], -accel * dt), accel * dt)
        self._point[2] += self._speed[2] * dt


def _approach(gap: float, top: float, accel: float) -> float:
    """Speed at which a stop within `gap` is easy: half the braking allowed, exponential at the end."""
    return min(top, math.sqrt(accel * gap), 1.5 * gap)
