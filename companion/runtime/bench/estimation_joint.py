"""Node of the joint window: IMU, sweeps and what images say, to states beside the filter's."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator

import numpy as np

from companion.core.geometry import quaternion_from_rotation, rotation_from_quaternion
from companion.core.messages import Array, ImuSample, LidarScan, LioState, PoseLikelihood, RegisteredScan, Why
from companion.core.node import Node, Output, Topic, on
from companion.core.rig import Rig
from companion.core.topics import IMU, LIDAR, LIKELIHOOD, LIO_STATE, REGISTERED, WHY
from companion.estimation.config import EstimationConfig
from companion.estimation.course import Course
from companion.estimation.filter import Filter
from companion.estimation.imu_doubt import new_buffer
from companion.estimation.normal import Normal
from companion.estimation.ordering import Reorder
from companion.estimation.point_map import PointMap
from companion.estimation.state import State
from companion.estimation.window.joint_window import JointWindow

JOINT_STATE = Topic("bench/joint_state", LioState, 10.0)
_MOVES_M_S = 0.3
_LATE_NS = 500_000_000  # sweeps of the last moment before it is known to move are held where they are not


class JointWindowNode(Node):
    """While the vehicle stands it goes along with the filter, and takes over its state and sweeps when it moves.

    From then on it has a map of its own, and takes nothing of the filter but what images say.
    """

    publishes = (JOINT_STATE, WHY)

    def __init__(self, config: EstimationConfig, rig: Rig) -> None:
        self._config, self._rig = config, rig
        self._imu = new_buffer(config.lio.imu_doubt)
        self._begin_anew()

    @on(IMU)
    def imu(self, sample: ImuSample) -> Iterator[Output]:
        """Buffer; work off what waited for this time."""
        if self._imu.append(sample):
            yield from self._work_off()

    @on(LIO_STATE)
    def state(self, state: LioState) -> Iterator[Output]:
        """Begin at the filter's state when it moves."""
        if state.source == "start":
            self._begin_anew()
        if self.window is None and state.source == "lidar":
            if np.linalg.norm(state.v_odom) > _MOVES_M_S:
                self._begin(state)
            yield JOINT_STATE(state)

    @on(REGISTERED)
    def registered(self, scan: RegisteredScan) -> None:
        """While it stands: into the map, once it is known that it stood."""
        if self.window is not None:
            return
        self._stood.append(scan)
        while self._stood[0].stamp_ns < scan.stamp_ns - _LATE_NS:
            first = self._stood.popleft()
            self._map.insert(first.points_body, rotation_from_quaternion(first.q_odom_body), first.p_odom)

    @on(LIDAR)
    def lidar(self, scan: LidarScan) -> Iterator[Output]:
        """Queue a sweep."""
        yield from self._queue("lidar", scan)

    @on(LIKELIHOOD)
    def likelihood(self, seen: PoseLikelihood) -> Iterator[Output]:
        """Queue what an image said."""
        if seen.source == "camera":
            yield from self._queue("camera", seen)

    def _begin_anew(self) -> None:
        c = self._config.order
        periods = {"lidar": round(c.lidar_period_s * 1e9), "camera": round(c.camera_period_s * 1e9)}
        self._order: Reorder[LidarScan | PoseLikelihood] = Reorder(
            hold_back_ns=round(c.hold_back_s * 1e9), periods_ns=periods
        )
        self.window: JointWindow | None = None
        self._map = PointMap(self._config.lio.map)
        self._stood: deque[RegisteredScan] = deque()
        self._time_ns = self._zero_ns = 0

    def _begin(self, state: LioState) -> None:
        start = Filter(state_of(state), np.array(state.covariance), 0.0)
        c = self._config
        self.window = JointWindow(Course(start), self._map, c.lio.rescue.window, c.lio, self._rig)
        self._zero_ns = self._time_ns = state.stamp_ns

    def _queue(self, stream: str, measurement: LidarScan | PoseLikelihood) -> Iterator[Output]:
        if self.window is not None:
            self._order.put(stream, measurement.stamp_ns, measurement, now_ns=self._imu.newest_ns)
            yield from self._work_off()

    def _work_off(self) -> Iterator[Output]:
        while self.window is not None and (measurement := self._order.take(self._imu.newest_ns)) is not None:
            if measurement.stamp_ns <= self._time_ns:
                continue
            try:
                yield from self._take(self.window, measurement)
            except np.linalg.LinAlgError as error:
                yield from self._give_up(str(error))

    def _take(self, window: JointWindow, measurement: LidarScan | PoseLikelihood) -> Iterator[Output]:
        stamp_ns = measurement.stamp_ns
        when = self._time_ns, stamp_ns
        window.predict(self._imu.between(*when), gap_s=self._imu.longest_gap_s(*when))
        self._time_ns = stamp_ns
        window.filter.t_s = (stamp_ns - self._zero_ns) * 1e-9  # no rounding adds up
        if isinstance(measurement, PoseLikelihood):
            window.add_seen(_normal_of(measurement))
            return
        window.add_sweep(measurement.points_sensor, measurement.point_age_s)
        if not window.filter.is_sound:
            yield from self._give_up("the numbers are no longer finite")
            return
        if window.normal is not None:
            yield JOINT_STATE(self._state(window, window.normal))

    def _give_up(self, because: str) -> Iterator[Output]:
        stamp_ns = self._time_ns
        self._begin_anew()
        yield WHY(Why(stamp_ns=stamp_ns, node="JointWindowNode", what="begin a new window", because=because))

    def _state(self, window: JointWindow, normal: Normal) -> LioState:
        state = window.filter.state
        return LioState(
            stamp_ns=self._time_ns,
            p_odom=state.p.copy(),
            q_odom_body=quaternion_from_rotation(state.R),
            v_odom=state.v.copy(),
            gyro_bias_body=state.gyro_bias.copy(),
            accel_bias_body=state.accel_bias.copy(),
            gravity_odom=state.g.copy(),
            covariance=window.covariance,
            source="lidar",
            inlier_fraction=normal.used / max(normal.offered, 1),
            weakest_direction=normal.weakest,
        )


def state_of(message: LioState) -> State:
    """The state that a message tells of."""
    state = State(np.zeros(24))
    state.R[:], state.p[:] = rotation_from_quaternion(message.q_odom_body), message.p_odom
    state.v[:], state.g[:] = message.v_odom, message.gravity_odom
    state.gyro_bias[:], state.accel_bias[:] = message.gyro_bias_body, message.accel_bias_body
    return state


def _normal_of(seen: PoseLikelihood) -> Normal:
    R: Array = rotation_from_quaternion(seen.q_odom_body)
    return Normal(R, np.array(seen.p_odom), np.array(seen.information), np.array(seen.gradient), 0, 0)
