"""Follows trajectories: one of three laws, PID on the error, braking on the path, limits, heading with a rate limit."""

from __future__ import annotations

import math
from typing import Annotated, Literal

import msgspec
import numpy as np

from companion.core.geometry import wrap_angle, yaw_of
from companion.core.messages import Array, Odometry, Setpoint, Trajectory
from companion.tracking.demand import Demand, across, limited
from companion.tracking.path import PathPoint, RegulationConfig, TrackedPath
from companion.tracking.pid import Pid, PidConfig
from companion.tracking.preview import PreviewConfig, preview
from companion.tracking.pure_pursuit import PursuitConfig, pure_pursuit

Metres = Annotated[float, msgspec.Meta(gt=0)]
Speed = Annotated[float, msgspec.Meta(gt=0)]
Method = Literal["preview", "pure_pursuit", "pid"]


class FollowConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The law, its parts, and heading."""

    method: Method = "preview"
    """preview: feed-forward from a point ahead and PID; pure_pursuit: chase a carrot; pid: PID alone."""
    preview: PreviewConfig = PreviewConfig()
    pursuit: PursuitConfig = PursuitConfig()
    pid: PidConfig = PidConfig()
    regulation: RegulationConfig = RegulationConfig()
    back_m: Metres = 1.0
    """The nearest point is looked for this far back ..."""
    forth_m: Metres = 4.0
    """... and this far ahead of the last one."""
    hold_speed_m_s: Speed = 1.0
    """At this demanded speed and above velocity alone is asked for; below the place to be, too, the more the slower."""
    change_share: Annotated[float, msgspec.Meta(ge=1)] = 2.0
    """The velocity demand changes by at most so many times the acceleration limit: a path that turns off sharply
    gives no jump, and is still met sooner than the vehicle answers."""
    astray_m: Metres = 0.3
    """Farther from the path than this, the speed along it shrinks ..."""
    astray_gone_m: Metres = 1.5
    """... to a quarter at this distance."""
    yaw_look_m: Metres = 1.5
    """The nose points to the path this far ahead ..."""
    yaw_least_m: Metres = 0.5
    """... unless that place is nearer than this in the horizontal: then the heading stays."""
    scale_speed_m_s: Speed = 0.5
    """Slowest planned speed that counts when the share of the speed changes."""


class Follower:
    """`take` a trajectory, then ask for a `setpoint` every `period_s`.

    Every setpoint's velocity is within the trajectory's top speed (or what a slow path and the PID's limit at right
    angles to it come to, if that is more), its acceleration within the acceleration limit, and the velocity changes
    by at most change_share times that.
    """

    def __init__(self, config: FollowConfig, *, period_s: float) -> None:
        self.config, self.period_s = config, period_s
        self._pid = Pid(config.pid)
        self._trajectory: Trajectory | None = None
        self._path: TrackedPath | None = None
        self._here: PathPoint | None = None  # nearest so far; None: not looked for yet
        self._new = False  # the path was not looked at yet
        self._scale = 1.0  # share of the planned speed
        self._stop: Array | None = None  # place where it stopped on the path, (3,)
        self._v: Array | None = None  # of the last setpoint, (3,)
        self._yaw: float | None = None

    def reset(self) -> None:
        """Inputs were lost: forget integral, last demand and heading."""
        self._pid.reset()
        self._v = self._yaw = None

    def take(self, trajectory: Trajectory) -> None:
        """Follow this from now on."""
        config, limit = self.config, trajectory.accel_limit
        self._trajectory = trajectory
        self._path = TrackedPath(trajectory.p_odom, trajectory.speed, accel_limit=limit, regulation=config.regulation)
        self._new = True

    def setpoint(self, now_ns: int, odometry: Odometry, *, scale: float) -> Setpoint:
        """Demand for now; `scale` 0..1 of the planned speed is reached by braking on the path."""
        assert self._path is not None
        p, v = odometry.p_odom, odometry.v_odom
        here = self._here = self._nearest(self._path, p)
        demand = self._scaled(self._demand(self._path, here, p, v), scale)
        error = demand.here.p - p if self._stop is None else self._stop - p
        if self.config.method == "pure_pursuit" and self._stop is None:
            correction = np.zeros(3)
        else:
            correction = self._pid.step(error, measured_rate=across(v, here.tangent), dt_s=self.period_s)
        velocity = self._limited_velocity(self._along(demand, error), correction, v)
        yaw, yaw_rate = self._heading(self._path, here, odometry)
        return Setpoint(
            stamp_ns=now_ns,
            p_odom=self._place(demand, p),
            v_odom=velocity,
            a_odom=limited(demand.a, self._path.accel_limit),
            yaw=yaw,
            yaw_rate=yaw_rate,
        )

    # --- parts ---------------------------------------------------------------------------

    def _nearest(self, path: TrackedPath, p: Array) -> PathPoint:
        """On a path that is followed near the last place; on a new one anywhere, the way of the old one preferred."""
        if self._here is None or self._new:
            direction = None if self._here is None else self._here.tangent
            self._new = False
            return path.at(path.nearest(p, direction=direction))
        s = self._here.s_m
        return path.at(path.nearest(p, window_m=(s - self.config.back_m, s + self.config.forth_m)))

    def _demand(self, path: TrackedPath, here: PathPoint, p: Array, v: Array) -> Demand:
        config = self.config
        if config.method == "pure_pursuit":
            return pure_pursuit(path, here, p, v, config.pursuit)
        if config.method == "preview":
            return preview(path, here, v, config.preview)
        ahead = path.at(here.s_m + config.preview.least_ahead_m)  # the nearest point's own speed is 0 at the start
        return Demand(here=here, place=here.p, v=ahead.speed * here.tangent, a=np.zeros(3))

    def _scaled(self, demand: Demand, scale: float) -> Demand:
        """The same at the present share of the speed, with the braking that changes it."""
        assert self._path is not None
        speed = max(demand.here.speed, self.config.scale_speed_m_s)
        most = self._path.accel_limit * self.period_s / speed
        before = self._scale
        self._scale = min(max(scale, before - most), before + most)
        if self._scale <= 0.0:
            if self._stop is None:
                self._stop = demand.here.p.copy()
            return Demand(here=demand.here, place=self._stop, v=np.zeros(3), a=np.zeros(3))
        self._stop = None
        braking = demand.v * ((self._scale - before) / self.period_s)
        return Demand(
            here=demand.here, place=demand.place, v=self._scale * demand.v, a=self._scale**2 * demand.a + braking
        )

    def _along(self, demand: Demand, error: Array) -> Array:
        """Velocity along the path, less where the vehicle is astray: first back to it, then on."""
        config = self.config
        off = (float(np.linalg.norm(error)) - config.astray_m) / max(config.astray_gone_m - config.astray_m, 1e-9)
        return demand.v * (1.0 - 0.75 * min(max(off, 0.0), 1.0))

    def _limited_velocity(self, along: Array, correction: Array, v: Array) -> Array:
        """Sum within the top speed, the correction first, changing at most by the acceleration limit.

        A correction never takes all of a slow path's speed: a climb that is off its line just above the ground,
        and gave up climbing for it, would sink back onto its legs while it moves sideways.
        """
        assert self._path is not None
        most_aside, top = self.config.pid.output_limit_m_s, self._path.top_speed
        top = max(top, math.hypot(min(top, most_aside), most_aside))
        wished = limited_sum(correction, along, top)
        last = limited(v, top) if self._v is None else limited(self._v, top)
        most = self.config.change_share * self._path.accel_limit * self.period_s
        self._v = last + limited(wished - last, most)
        return self._v.copy()

    def _place(self, demand: Demand, p: Array) -> Array:
        """The place to be, for the autopilot's own position loop: whole at hover, none when fast."""
        share = 1.0 - float(np.linalg.norm(demand.v)) / self.config.hold_speed_m_s
        if share <= 0.0:
            return np.full(3, np.nan)
        if self._stop is not None:
            return self._stop.copy()
        place: Array = p + min(share * 2.0, 1.0) * (demand.place - p)
        return place

    def _heading(self, path: TrackedPath, here: PathPoint, odometry: Odometry) -> tuple[float, float]:
        """(yaw, yaw rate), turning towards what is wished for at most at the limit."""
        assert self._trajectory is not None
        config, now = self.config, self._yaw
        if now is None:
            now = yaw_of(odometry.q_odom_body)
        wished = self._trajectory.yaw
        if math.isnan(wished):
            way = path.at(here.s_m + config.yaw_look_m).p - odometry.p_odom
            far = math.hypot(way[0], way[1]) >= config.yaw_least_m
            wished = math.atan2(way[1], way[0]) if far else now
        most = self._trajectory.yaw_rate_limit * self.period_s
        turn = min(max(wrap_angle(wished - now), -most), most)
        self._yaw = wrap_angle(now + turn)
        return self._yaw, turn / self.period_s


def limited_sum(first: Array, second: Array, most: float) -> Array:
    """first + share * second (3,) with the largest share up to 1 that keeps the norm within `most`.

    `first` alone is shortened if it is longer.
    """
    total: Array = first + second
    if float(np.linalg.norm(total)) <= most:
        return total
    size2 = float(first @ first)
    if size2 >= most * most:
        return limited(first, most)
    along, square = float(first @ second), float(second @ second)
    share = (-along + math.sqrt(max(along * along + square * (most * most - size2), 0.0))) / square
    return limited(first + share * second, most)
