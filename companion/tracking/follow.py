"""Follows trajectories: preview, cross-track PID, braking on the path, heading with a rate limit."""

from __future__ import annotations

import math
from typing import Annotated

import msgspec
import numpy as np

from companion.core.geometry import wrap_angle, yaw_of
from companion.core.messages import Array, Odometry, Setpoint, Trajectory
from companion.tracking.pid import Pid, PidConfig
from companion.tracking.pure_pursuit import Preview, Pursuit, PursuitConfig

Metres = Annotated[float, msgspec.Meta(gt=0)]


class FollowConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Pursuit, PID and heading."""

    pursuit: PursuitConfig = PursuitConfig()
    pid: PidConfig = PidConfig()
    drag_per_s: Annotated[float, msgspec.Meta(ge=0)] = 0.1
    """Deceleration per speed by rotor drag in still air, fed forward: else the autopilot's integral
    carries it, and overshoots at the end."""
    yaw_look_m: Metres = 1.5
    """The nose points to the path this far ahead ..."""
    yaw_least_m: Metres = 0.5
    """... unless that place is nearer than this in the horizontal: then the heading stays."""
    scale_speed_m_s: Annotated[float, msgspec.Meta(gt=0)] = 0.5
    """Slowest planned speed that counts when the share of the speed changes."""


class Follower:
    """`take` a trajectory, then ask for a `setpoint` every `period_s`."""

    def __init__(self, config: FollowConfig, *, period_s: float) -> None:
        self.config, self.period_s = config, period_s
        self._pid = Pid(config.pid)
        self._trajectory: Trajectory | None = None
        self._pursuit: Pursuit | None = None
        self._scale = 1.0  # share of the planned speed
        self._stop: Array | None = None  # place where it stopped on the path, (3,)
        self._yaw: float | None = None

    def reset(self) -> None:
        """Inputs were lost: forget integral and heading."""
        self._pid.reset()
        self._yaw = None

    def take(self, trajectory: Trajectory) -> None:
        """Follow this from now on."""
        self._trajectory = trajectory
        self._pursuit = Pursuit(
            trajectory.p_odom,
            trajectory.speed,
            accel_limit=trajectory.accel_limit,
            config=self.config.pursuit,
        )

    def setpoint(self, now_ns: int, odometry: Odometry, *, scale: float) -> Setpoint:
        """Demand for now; `scale` 0..1 of the planned speed is reached by braking on the path."""
        assert self._pursuit is not None
        p = odometry.p_odom
        preview = self._pursuit.preview(p, odometry.v_odom)
        place, v, a = self._scaled(preview, scale)
        tangent = preview.v / max(float(np.linalg.norm(preview.v)), 1e-9)
        error = preview.error if self._stop is None else self._stop - p
        across = error - float(error @ tangent) * tangent
        v = v + self._pid.step(across, dt_s=self.period_s)
        yaw, yaw_rate = self._heading(odometry)
        return Setpoint(stamp_ns=now_ns, p_odom=place, v_odom=v, a_odom=a, yaw=yaw, yaw_rate=yaw_rate)

    def _scaled(self, preview: Preview, scale: float) -> tuple[Array, Array, Array]:
        """Place, velocity, acceleration at the present share of the speed."""
        assert self._trajectory is not None
        speed = max(preview.speed, self.config.scale_speed_m_s)
        most = self._trajectory.accel_limit * self.period_s / speed
        before = self._scale
        self._scale = min(max(scale, before - most), before + most)
        if self._scale <= 0.0:
            if self._stop is None:
                self._stop = preview.p.copy()
            return self._stop.copy(), np.zeros(3), np.zeros(3)
        self._stop = None
        drag = self.config.drag_per_s * self._scale * preview.v
        braking = preview.v * (self._scale - before) / self.period_s
        return preview.p, self._scale * preview.v, self._scale**2 * preview.a + braking + drag

    def _heading(self, odometry: Odometry) -> tuple[float, float]:
        """(yaw, yaw rate), turning towards what is wished for at most at the limit."""
        assert self._trajectory is not None and self._pursuit is not None
        config, now = self.config, self._yaw
        if now is None:
            now = yaw_of(odometry.q_odom_body)
        wished: float | None = self._trajectory.yaw
        if math.isnan(self._trajectory.yaw):
            wished = self._pursuit.heading_ahead(odometry.p_odom, look_m=config.yaw_look_m, least_m=config.yaw_least_m)
        turn = 0.0 if wished is None else wrap_angle(wished - now)
        most = self._trajectory.yaw_rate_limit * self.period_s
        turn = min(max(turn, -most), most)
        self._yaw = wrap_angle(now + turn)
        return self._yaw, turn / self.period_s
