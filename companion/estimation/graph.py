"""Fixed-lag smoother over the last seconds: biases, gravity, and the correction of `odom`.

IMU factors after C. Forster et al., "On-Manifold Preintegration", T-RO 2017, with the direction
of gravity as a variable; LiDAR and camera enter as likelihoods (normal equations without the
IMU prior), so nothing is counted twice. The graph does not sharpen the pose, but the biases,
and it is where late and absolute measurements belong.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any, Literal

import gtsam
import msgspec
import numpy as np
from gtsam.symbol_shorthand import B, G, V, X

from companion.core.geometry import rotation_from_quaternion
from companion.core.messages import Array, PoseLikelihood
from companion.estimation.propagation import ImuNoise
from companion.estimation.so3 import tilt_free

Positive = Annotated[float, msgspec.Meta(gt=0)]


class GraphConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The smoother."""

    lag_s: Positive = 2.0
    updates: Annotated[int, msgspec.Meta(ge=1, le=5)] = 2  # of iSAM2 per node
    relinearise_above: Positive = 0.01
    factorization: Literal["QR", "CHOLESKY"] = "QR"
    weakest_eigenvalue: Positive = 1e2  # directions of a likelihood below it are left out
    gravity_sigma_rad: Positive = 0.015  # of the start
    accel_bias_sigma_m_s2: Positive = 0.1
    gyro_bias_sigma_rad_s: Positive = 2e-3


@dataclass(frozen=True, slots=True)
class Smoothed:
    """The newest node in the gauge of `odom`."""

    pose: Any  # gtsam.Pose3
    v: Array  # (3,)
    gyro_bias: Array  # (3,)
    accel_bias: Array  # (3,)
    down: Array  # unit, (3,)
    pose_variance: Array  # theta_body then p, (6,)
    factors: int

    @property
    def R_map_gauge(self) -> Array:
        """Levels the gauge frame: the smallest rotation that turns gravity onto -z."""
        return tilt_free(-self.down)


class Smoother:
    """One node per likelihood; drops what is older than the lag."""

    def __init__(self, start: StartNode, noise: ImuNoise, config: GraphConfig, *, gravity_m_s2: float) -> None:
        self.config = config
        self._params = _imu_params(noise, gravity_m_s2)
        isam = gtsam.ISAM2Params()
        isam.setRelinearizeThreshold(config.relinearise_above)
        isam.relinearizeSkip = 1
        isam.setFactorization(config.factorization)
        self._smoother = gtsam.IncrementalFixedLagSmoother(config.lag_s, isam)
        self._bias = gtsam.imuBias.ConstantBias(start.accel_bias, start.gyro_bias)
        self._state = gtsam.NavState(gtsam.Rot3(start.R), start.p, start.v)
        self._node = 0
        self._update(_start_priors(self._state, self._bias, start.down, config), self._values(start.down), 0.0)

    def add(self, imu: Array, likelihood: PoseLikelihood, *, t_s: float) -> None:
        """Append a node at `t_s` (seconds since the start) from what was seen there.

        `imu` (N, 7) holds the pieces since the last node; empty: the same instant, no new node.
        Raises RuntimeError if the system cannot be solved; the smoother is then of no more use.
        """
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        if len(imu):
            self._append_node(imu, graph)
            values = self._values(None)
        seen = likelihood_factor(X(self._node), likelihood, weakest=self.config.weakest_eigenvalue)
        if seen is not None:
            graph.add(seen)
        self._update(graph, values, t_s)

    def _append_node(self, imu: Array, graph: Any) -> None:
        before, node = self._node, self._node + 1
        measured = gtsam.PreintegratedCombinedMeasurements(self._params, self._bias)
        for row in imu:
            measured.integrateMeasurement(row[4:7], row[1:4], row[0])
        keys = (X(before), V(before), X(node), V(node), B(before), B(node), G(0))
        graph.add(gtsam.CombinedImuFactorWithGravityDirection(*keys, measured))
        self._state, self._node = measured.predict(self._state, self._bias), node

    def _values(self, down: Array | None) -> Any:
        values = gtsam.Values()
        values.insert(X(self._node), self._state.pose())
        values.insert(V(self._node), self._state.velocity())
        values.insert(B(self._node), self._bias)
        if down is not None:
            values.insert(G(0), gtsam.Unit3(down))
        return values

    def _update(self, graph: Any, values: Any, t_s: float) -> None:
        node = self._node
        # G(0) is stamped anew each time: a key left behind would be marginalised, one stamped
        # ahead would marginalise all others.
        stamps: dict[Any, Any] = {X(node): t_s, V(node): t_s, B(node): t_s, G(0): t_s}
        self._smoother.update(graph, values, stamps)
        for _ in range(self.config.updates - 1):
            self._smoother.update()
        pose = self._smoother.calculateEstimatePose3(X(node))
        self._state = gtsam.NavState(pose, self._smoother.calculateEstimateVector(V(node)))
        self._bias = self._smoother.calculateEstimateConstantBias(B(node))

    def newest(self) -> Smoothed:
        """The state of the newest node."""
        return Smoothed(
            pose=self._state.pose(),
            v=np.array(self._state.velocity()),
            gyro_bias=np.array(self._bias.gyroscope()),
            accel_bias=np.array(self._bias.accelerometer()),
            down=np.array(self._smoother.calculateEstimate().atUnit3(G(0)).unitVector()).ravel(),
            pose_variance=np.diag(self._smoother.marginalCovariance(X(self._node))).copy(),
            factors=self._smoother.getFactors().nrFactors(),
        )


@dataclass(frozen=True, slots=True)
class StartNode:
    """Where the graph begins: the filter's start."""

    R: Array  # odom <- body, (3, 3)
    p: Array  # (3,)
    v: Array  # (3,)
    gyro_bias: Array  # (3,)
    accel_bias: Array  # (3,)
    down: Array  # unit vector in odom, (3,)


def likelihood_factor(key: int, likelihood: PoseLikelihood, *, weakest: float) -> Any:
    """A pose likelihood as a linear factor at its linearisation pose; None if it says nothing.

    gtsam's Pose3 tangent is right-handed: its translation part is in the body, p = p0 + R dp,
    so H and g are turned by blkdiag(I, R). Directions with an eigenvalue below `weakest` are
    left out.
    """
    R = rotation_from_quaternion(likelihood.q_odom_body)
    turn = np.eye(6)
    turn[3:, 3:] = R
    H = turn.T @ likelihood.information @ turn
    values, vectors = np.linalg.eigh(0.5 * (H + H.T))
    kept = values > weakest
    if not kept.any():
        return None
    root = np.sqrt(values[kept])
    A = root[:, None] * vectors[:, kept].T
    b = vectors[:, kept].T @ (turn.T @ likelihood.gradient) / root
    at = gtsam.Values()
    at.insert(key, gtsam.Pose3(gtsam.Rot3(R), likelihood.p_odom))
    linear = gtsam.JacobianFactor(key, A, b, gtsam.noiseModel.Unit.Create(len(b)))
    return gtsam.LinearContainerFactor(linear, at)


def _imu_params(noise: ImuNoise, gravity_m_s2: float) -> Any:
    params = gtsam.PreintegrationCombinedParams.MakeSharedU(gravity_m_s2)
    gyro, accel, gyro_walk, accel_walk = noise.densities
    params.setGyroscopeCovariance(np.eye(3) * gyro)
    params.setAccelerometerCovariance(np.eye(3) * accel)
    params.setIntegrationCovariance(np.eye(3) * 1e-8)
    params.setBiasOmegaCovariance(np.eye(3) * gyro_walk)
    params.setBiasAccCovariance(np.eye(3) * accel_walk)
    return params


def _start_priors(state: Any, bias: Any, down: Array, config: GraphConfig) -> Any:
    """The attitude is the gauge; gravity and biases are free within the start's uncertainty."""
    graph = gtsam.NonlinearFactorGraph()
    sigmas = gtsam.noiseModel.Diagonal.Sigmas
    bias_sigmas = np.repeat([config.accel_bias_sigma_m_s2, config.gyro_bias_sigma_rad_s], 3)
    graph.add(gtsam.PriorFactorPose3(X(0), state.pose(), sigmas(np.full(6, 1e-4))))
    graph.add(gtsam.PriorFactorVector(V(0), state.velocity(), sigmas(np.full(3, 1e-2))))
    graph.add(gtsam.PriorFactorConstantBias(B(0), bias, sigmas(bias_sigmas)))
    graph.add(gtsam.PriorFactorUnit3(G(0), gtsam.Unit3(down), sigmas(np.full(2, config.gravity_sigma_rad))))
    return graph
