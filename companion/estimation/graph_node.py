"""Graph node: likelihoods and IMU to the smoothed state and the correction of `odom`."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from companion.core.geometry import quaternion_from_rotation, rotation_from_quaternion
from companion.core.messages import Array, ImuSample, LioState, MapFromOdom, PoseLikelihood, SmoothedState, Why
from companion.core.node import Node, Output, on
from companion.core.rig import Rig
from companion.core.topics import IMU, LIKELIHOOD, LIO_STATE, MAP_FROM_ODOM, SMOOTHED, WHY
from companion.estimation.config import EstimationConfig
from companion.estimation.graph import Smoothed, Smoother, StartNode
from companion.estimation.imu_doubt import new_buffer

_NEAREST_NS = 100_000  # two nodes keep this distance; what is closer belongs to one


class GraphNode(Node):
    """One graph node per likelihood; publishes after those of scans.

    `map` is the graph's frame levelled by its estimate of gravity, so `map` <- `odom` begins
    as the identity and grows to the small tilt that the accelerometer bias hid at the start. What
    loops say of the way since then comes on top, so that home is where the vehicle has started from.
    """

    publishes = (SMOOTHED, WHY)

    def __init__(self, config: EstimationConfig, rig: Rig) -> None:
        self._config, self._rig = config, rig
        self._imu = new_buffer(config.lio.imu_doubt)
        self._smoother: Smoother | None = None
        self._state: LioState | None = None
        self._loops = np.eye(3), np.zeros(3)  # R, p: by closures, from odom of now to that of the start
        self._zero_ns = self._time_ns = 0

    @on(IMU)
    def imu(self, sample: ImuSample) -> None:
        """Buffer."""
        self._imu.append(sample)

    @on(LIO_STATE)
    def state(self, state: LioState) -> None:
        """Remember the filter's word; begin a graph at its start."""
        self._state = state
        if state.source == "start":
            self._begin(state)

    @on(MAP_FROM_ODOM)
    def loops(self, found: MapFromOdom) -> None:
        """Take what closures say of the drift; the identity after a start."""
        self._loops = rotation_from_quaternion(found.q_map_odom), found.p_map_odom

    @on(LIKELIHOOD)
    def likelihood(self, likelihood: PoseLikelihood) -> Iterator[Output]:
        """Add a node."""
        if self._smoother is None or likelihood.stamp_ns < self._time_ns or not len(self._imu):
            return
        stamp_ns = likelihood.stamp_ns
        if stamp_ns - self._time_ns < _NEAREST_NS:
            stamp_ns = self._time_ns
        if self._imu.longest_gap_s(self._time_ns, stamp_ns) > self._config.lio.imu_doubt.clock_s:
            yield from self._begin_again(stamp_ns, "all sensors were silent, or the clock has jumped")
            return
        imu = self._imu.between(self._time_ns, stamp_ns)
        try:
            self._smoother.add(imu, likelihood, t_s=(stamp_ns - self._zero_ns) * 1e-9)
            is_scan = likelihood.source == "lidar"
            smoothed = self._smoother.newest() if is_scan else None
        except RuntimeError as error:
            yield from self._begin_again(likelihood.stamp_ns, str(error))
            return
        self._time_ns = stamp_ns
        if smoothed and self._state and self._state.stamp_ns == likelihood.stamp_ns:
            yield SMOOTHED(_message(smoothed, self._state, self._loops))

    def _begin(self, state: LioState) -> None:
        start = StartNode(
            R=rotation_from_quaternion(state.q_odom_body),
            p=state.p_odom,
            v=state.v_odom,
            gyro_bias=state.gyro_bias_body,
            accel_bias=state.accel_bias_body,
            down=state.gravity_odom / np.linalg.norm(state.gravity_odom),
        )
        lio, graph = self._config.lio, self._config.graph
        self._smoother = Smoother(start, lio.noise, graph, gravity_m_s2=lio.start.gravity_m_s2)
        self._zero_ns = self._time_ns = state.stamp_ns

    def _begin_again(self, stamp_ns: int, problem: str) -> Iterator[Output]:
        """From the filter's newest state: a smoother that failed cannot be mended."""
        if self._state is not None:
            self._begin(self._state)
        because = problem.strip().splitlines()[0] if problem.strip() else "the graph could not be solved"
        yield WHY(Why(stamp_ns=stamp_ns, node="GraphNode", what="begin a new graph", because=because))


def _message(smoothed: Smoothed, state: LioState, loops: tuple[Array, Array]) -> SmoothedState:
    level, R_odom_body = smoothed.R_map_gauge, rotation_from_quaternion(state.q_odom_body)
    R_graph = level @ smoothed.pose.rotation().matrix() @ R_odom_body.T
    p_graph = level @ np.asarray(smoothed.pose.translation()) - R_graph @ state.p_odom
    R_map_odom, p_map_odom = R_graph @ loops[0], R_graph @ loops[1] + p_graph
    return SmoothedState(
        stamp_ns=state.stamp_ns,
        p_map=R_map_odom @ state.p_odom + p_map_odom,
        q_map_body=quaternion_from_rotation(R_map_odom @ R_odom_body),
        v_map=R_map_odom @ R_graph.T @ level @ smoothed.v,
        gyro_bias_body=smoothed.gyro_bias,
        accel_bias_body=smoothed.accel_bias,
        p_map_odom=p_map_odom,
        q_map_odom=quaternion_from_rotation(R_map_odom),
        pose_variance=smoothed.pose_variance,
        factors=smoothed.factors,
    )
