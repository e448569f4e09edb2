"""Tracking: trajectories in, setpoints out at 50 Hz; nothing goes out on stale input."""

from __future__ import annotations

from typing import Annotated

import msgspec
import numpy as np

from companion.core import topics
from companion.core.geometry import yaw_of
from companion.core.messages import Array, Odometry, SafetyStatus, Setpoint, Trajectory
from companion.core.node import Node, Outputs, every, on
from companion.tracking.follow import FollowConfig, Follower

Seconds = Annotated[float, msgspec.Meta(gt=0)]
Metres = Annotated[float, msgspec.Meta(gt=0)]
RATE_HZ = 50


class TrackingConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Tracking and its algorithms."""

    follow: FollowConfig = FollowConfig()
    odometry_stale_s: Seconds = 0.2
    """Older odometry: no setpoint."""
    safety_stale_s: Seconds = 0.3
    """Older word of the guards: no setpoint."""
    trajectory_stale_s: Seconds = 1.5
    """Older trajectory: brake on the path."""
    anchor_m: Metres = 0.3
    """Without a trajectory the vehicle is held where it is; farther off, a new place is taken."""


class TrackingNode(Node):
    """Follows the newest trajectory; brakes on it when told so or when it gets old."""

    publishes = (topics.SETPOINT,)

    def __init__(self, config: TrackingConfig) -> None:
        self.config = config
        self._odometry: Odometry | None = None
        self._safety: SafetyStatus | None = None
        self._trajectory: Trajectory | None = None
        self._follower = Follower(config.follow, period_s=1.0 / RATE_HZ)
        self._anchor: Array | None = None

    @on(topics.ODOMETRY)
    def take_odometry(self, message: Odometry) -> None:
        """The newest state."""
        self._odometry = message

    @on(topics.SAFETY)
    def take_safety(self, message: SafetyStatus) -> None:
        """The guards' newest verdict."""
        self._safety = message

    @on(topics.TRAJECTORY)
    def take_trajectory(self, message: Trajectory) -> None:
        """A new path; one older than the present is ignored."""
        if self._trajectory is None or message.stamp_ns >= self._trajectory.stamp_ns:
            self._trajectory = message
            self._follower.take(message)

    @every(hz=RATE_HZ)
    def control(self, now_ns: int) -> Outputs:
        """One setpoint, if the inputs are fresh."""
        odometry, safety, config = self._odometry, self._safety, self.config
        fresh = (
            odometry is not None
            and safety is not None
            and not _older(odometry.stamp_ns, now_ns, config.odometry_stale_s)
            and not _older(safety.stamp_ns, now_ns, config.safety_stale_s)
        )
        if not fresh or odometry is None or safety is None:
            self._follower.reset()
            return
        if self._trajectory is None:
            yield topics.SETPOINT(self._hold_here(now_ns, odometry))
            return
        stale = _older(self._trajectory.stamp_ns, now_ns, config.trajectory_stale_s)
        stop = stale or safety.action in ("hold", "land")
        scale = 0.0 if stop else safety.speed_scale
        yield topics.SETPOINT(self._follower.setpoint(now_ns, odometry, scale=scale))

    def _hold_here(self, now_ns: int, odometry: Odometry) -> Setpoint:
        """The autopilot wants a stream before it accepts OFFBOARD: stay in place."""
        far = self._anchor is None or np.linalg.norm(odometry.p_odom - self._anchor) > self.config.anchor_m
        if far or self._anchor is None:
            self._anchor = odometry.p_odom.copy()
        return Setpoint(
            stamp_ns=now_ns,
            p_odom=self._anchor.copy(),
            v_odom=np.zeros(3),
            a_odom=np.zeros(3),
            yaw=yaw_of(odometry.q_odom_body),
            yaw_rate=0.0,
        )


def _older(stamp_ns: int, now_ns: int, most_s: float) -> bool:
    return now_ns - stamp_ns > round(most_s * 1e9)
