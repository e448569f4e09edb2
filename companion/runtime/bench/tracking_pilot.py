"""Two nodes that let a tracker be measured without a planner: one that leads, one that tells the truth.

`PilotNode` arms, climbs, sends one path as a planner does, again and again, and ends. `TrueOdometryNode`
stands in for the estimators where only vehicle, autopilot and tracker are looked at.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from companion.core import topics
from companion.core.correction import Correction
from companion.core.geometry import wrap_angle, yaw_of
from companion.core.messages import (
    Array,
    GroundTruth,
    Odometry,
    SafetyStatus,
    SmoothedState,
    Trajectory,
    VehicleCommand,
    VehicleStatus,
)
from companion.core.node import Node, Outputs, every, on
from companion.mission.route import LEG_M, TURN_RAD
from companion.planning.config import PlanningConfig

_CLIMB_M_S, _CLIMB_ACCEL = 1.0, 1.0
_CALM_S = 1.5  # hovering before the path begins, and after it has ended
_TURN_ABOVE_M = PlanningConfig().turn_above_m
_CLIMB_S = 8.0  # to the start of the path and for the autopilot's integrals to settle


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Course:
    """What is to be flown: `points` (N, 3) m in map, evenly spaced, from above the start; `speeds` (N,) m/s."""

    name: str
    points: Array
    speeds: Array
    limit_m_s: float
    accel: float  # m/s2
    yaw_rate: float = 1.5  # rad/s

    @property
    def seconds(self) -> float:
        """How long it takes as planned."""
        steps = np.linalg.norm(np.diff(self.points, axis=0), axis=1)
        mean = 0.5 * (self.speeds[1:] + self.speeds[:-1])
        return float(np.sum(steps / np.maximum(mean, 0.05)))


class PilotNode(Node):
    """Says what planner, mission and guards would; `begun_ns` is when the path was first sent.

    As in a mission the path, which lies in map, is carried over into odom anew every `LEG_M` of the way. With `turns`
    the vehicle turns about as it climbs, which estimators are the better for; where the truth stands in for them
    it would only begin the path with its back to it.
    """

    publishes = (topics.TRAJECTORY, topics.SAFETY, topics.VEHICLE_COMMAND)

    def __init__(self, course: Course, *, turns: bool) -> None:
        self.course, self._turns = course, turns
        self.begun_ns: int | None = None
        self.done = False
        self._odometry: Odometry | None = None
        self._smoothed: SmoothedState | None = None
        self._placed = course.points  # in odom
        self._placed_at = np.full(3, np.inf)  # where the vehicle was then, in odom
        self._vehicle: VehicleStatus | None = None
        self._up = _climb(float(course.points[0, 2]), course.points[0])
        self._up_ns: int | None = None
        self._turned = math.nan  # heading once up
        self._rest_ns: int | None = None
        self._steps = 0

    @on(topics.ODOMETRY)
    def take_odometry(self, message: Odometry) -> None:
        """Where the vehicle believes to be."""
        self._odometry = message

    @on(topics.SMOOTHED)
    def take_smoothed(self, message: SmoothedState) -> None:
        """Where odom lies in map."""
        self._smoothed = message

    @on(topics.VEHICLE)
    def take_vehicle(self, message: VehicleStatus) -> None:
        """Whether it may be armed, and flies."""
        self._vehicle = message

    @every(hz=20)
    def step(self, now_ns: int) -> Outputs:
        """Guards at 20 Hz, paths at 5 Hz, commands once a second until they are done."""
        self._steps += 1
        yield topics.SAFETY(SafetyStatus(stamp_ns=now_ns, action="ok", speed_scale=1.0, reason=""))
        if self._vehicle is None or self._odometry is None or self.done:
            return
        if self._steps % 20 == 0 and self._vehicle.ready | self._vehicle.armed:
            yield from self._command(now_ns)
        if self._vehicle.armed and self._vehicle.mode == "OFFBOARD" and self._steps % 4 == 0:
            yield topics.TRAJECTORY(self._path(now_ns))
            self._look(now_ns)

    def _command(self, now_ns: int) -> Outputs:
        assert self._vehicle is not None
        if self._vehicle.mode != "OFFBOARD":
            yield topics.VEHICLE_COMMAND(VehicleCommand(stamp_ns=now_ns, kind="offboard"))
        elif not self._vehicle.armed:
            yield topics.VEHICLE_COMMAND(VehicleCommand(stamp_ns=now_ns, kind="arm"))

    def _path(self, now_ns: int) -> Trajectory:
        assert self._odometry is not None
        if self._up_ns is None:
            self._up_ns = now_ns
            self._turned = wrap_angle(yaw_of(self._odometry.q_odom_body) + TURN_RAD) if self._turns else math.nan
        points, speeds, accel = self._up
        yaw = self._turned if self._odometry.p_odom[2] > _TURN_ABOVE_M else math.nan
        if now_ns - self._up_ns > _CLIMB_S * 1e9:
            self.begun_ns = now_ns if self.begun_ns is None else self.begun_ns
            points, speeds, accel = self._in_odom(), self.course.speeds, self.course.accel
            yaw = math.nan
        return Trajectory(
            stamp_ns=now_ns,
            goal_id=0 if self.begun_ns is None else 1,
            p_odom=points,
            speed=speeds,
            accel_limit=accel,
            yaw=yaw,
            yaw_rate_limit=self.course.yaw_rate,
        )

    def _in_odom(self) -> Array:
        """The path, placed at the begin and after each leg."""
        assert self._odometry is not None
        if not np.linalg.norm(self._odometry.p_odom - self._placed_at) < LEG_M:
            self._placed_at = self._odometry.p_odom
            self._placed = Correction.newest(self._smoothed).to_odom(self.course.points)
        return self._placed

    def _look(self, now_ns: int) -> None:
        """Done: near the end for a while, or twice as long under way as planned."""
        if self.begun_ns is None or self._odometry is None:
            return
        near = float(np.linalg.norm(self._odometry.p_odom - self._placed[-1])) < 0.4
        self._rest_ns = (now_ns if self._rest_ns is None else self._rest_ns) if near else None
        calm = self._rest_ns is not None and now_ns - self._rest_ns > _CALM_S * 1e9
        self.done = calm or now_ns - self.begun_ns > (2.0 * self.course.seconds + 10.0) * 1e9


class TrueOdometryNode(Node):
    """The truth as odometry, 50 Hz: what a perfect estimator would say."""

    publishes = (topics.ODOMETRY,)

    @on(topics.TRUTH)
    def take_truth(self, truth: GroundTruth) -> Outputs:
        """Pass it on."""
        yield topics.ODOMETRY(
            Odometry(
                stamp_ns=truth.stamp_ns,
                p_odom=truth.p_world.copy(),
                q_odom_body=truth.q_world_body.copy(),
                v_odom=truth.v_world.copy(),
                omega_body=np.zeros(3),
                pose_variance=np.full(6, 1e-4),
                velocity_variance=np.full(3, 1e-4),
                measured_ns=truth.stamp_ns,
                quality=1.0,
                reset_counter=0,
            )
        )


def _climb(height_m: float, top: Array) -> tuple[Array, Array, float]:
    """Points, speeds, acceleration of the way up."""
    z = np.linspace(0.0, height_m, max(round(height_m / 0.1), 1) + 1)
    points = np.column_stack([np.full(len(z), top[0]), np.full(len(z), top[1]), z])
    speeds = np.minimum(_CLIMB_M_S, np.sqrt(2 * _CLIMB_ACCEL * np.maximum(np.minimum(z + 0.05, height_m - z), 0.0)))
    return points, speeds, _CLIMB_ACCEL
