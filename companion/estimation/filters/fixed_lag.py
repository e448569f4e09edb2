"""A fixed-lag smoother behind the filters' interface: the last seconds are estimated jointly, again and again.

Unlike a filter it moves its linearisation points within the lag, so a bad start or a late turn
is mended by what follows. IMU factors after C. Forster et al., "On-Manifold Preintegration",
T-RO 2017; measurements are the filters' own models, as custom factors of gtsam.
"""

from __future__ import annotations

from typing import Any

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, V, X

from companion.core.messages import Array
from companion.estimation.filters.kalman import Innovation
from companion.estimation.filters.measurements import Measurement
from companion.estimation.propagation import ImuNoise, propagate
from companion.estimation.state import State

_BLOCKS = ((0, 6), (6, 9), (9, 15))  # of gtsam's tangents: pose, velocity, biases


class FixedLagFilter:
    """`predict` gathers IMU pieces, `correct` closes them with a node; the state is that of the newest node.

    Gravity is taken from the start and not estimated.
    """

    def __init__(self, state: State, P: Array, t_s: float, noise: ImuNoise, *, lag_s: float = 2.0) -> None:
        self.state, self.P, self.t_s = state.copy(), P.copy(), t_s
        self._params = _imu_params(noise, float(np.linalg.norm(state.g)))
        self._pieces: list[Array] = []
        isam = gtsam.ISAM2Params()
        isam.setRelinearizeThreshold(0.01)
        isam.relinearizeSkip = 1
        isam.setFactorization("QR")  # Cholesky fails on the stiff walk of the biases
        self._smoother = gtsam.IncrementalFixedLagSmoother(lag_s, isam)
        self._node = 0
        self._solve(_priors(self._keys(), state, P), self._values(state))

    def predict(self, imu: Array, densities: Array) -> Array:
        """Run IMU pieces (N, 7) through the state; returns the nodes passed, (N, 22)."""
        if not len(imu):
            return np.empty((0, 22))
        nodes = propagate(self.state, self.P, imu, densities, t_s=self.t_s)
        self._pieces.append(imu)
        self.t_s += float(imu[:, 0].sum())
        return nodes

    def correct(self, measurement: Measurement, *, gate_nis: float = np.inf) -> Innovation:
        """Take a measurement, unless its normalised innovation squared exceeds `gate_nis`."""
        H = measurement.jacobian(self.state)
        residual = measurement.z - measurement.expected(self.state)
        said = Innovation(residual, H @ self.P @ H.T + measurement.noise)
        if said.nis > gate_nis:
            return said
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        if self._pieces:
            values = self._append_node(graph)
        noise = gtsam.noiseModel.Gaussian.Covariance(measurement.noise)
        graph.add(gtsam.CustomFactor(noise, self._keys(), _measurement_error(measurement, self.state.g.copy())))
        self._solve(graph, values)
        return said

    def _append_node(self, graph: Any) -> Any:
        before = self._keys()
        measured = gtsam.PreintegratedCombinedMeasurements(self._params, self._bias())
        for row in np.concatenate(self._pieces):
            measured.integrateMeasurement(row[4:7], row[1:4], row[0])
        self._pieces, self._node = [], self._node + 1
        now = self._keys()
        keys = (before[0], before[1], now[0], now[1], before[2], now[2])
        graph.add(gtsam.CombinedImuFactor(*keys, measured))
        return self._values(self.state)

    def _solve(self, graph: Any, values: Any) -> None:
        stamps: dict[Any, Any] = {key: self.t_s for key in self._keys()}
        self._smoother.update(graph, values, stamps if values.size() else {})
        self._smoother.update()
        x, v, b = self._keys()
        pose = self._smoother.calculateEstimatePose3(x)
        self.state.R[:], self.state.p[:] = pose.rotation().matrix(), pose.translation()
        self.state.v[:] = self._smoother.calculateEstimateVector(v)
        bias = self._smoother.calculateEstimateConstantBias(b)
        self.state.gyro_bias[:], self.state.accel_bias[:] = bias.gyroscope(), bias.accelerometer()
        self.P[:15, :15] = self._covariance()

    def _covariance(self) -> Array:
        """Of the newest node in the error state, (15, 15): its corner of the square root of the whole information."""
        values = self._smoother.calculateEstimate()
        keys = self._keys()
        ordering = gtsam.Ordering()
        for key in [*(k for k in values.keys() if k not in keys), *keys]:  # noqa: SIM118 (gtsam's own class)
            ordering.push_back(key)
        A, _ = self._smoother.getFactors().linearize(values).jacobian(ordering)
        corner = np.asarray(np.linalg.qr(A, mode="r"))[-15:, -15:]
        root = _error_by_tangent(self.state.R) @ np.linalg.inv(corner)
        P: Array = root @ root.T
        return P

    def _values(self, state: State) -> Any:
        values = gtsam.Values()
        x, v, b = self._keys()
        values.insert(x, gtsam.Pose3(gtsam.Rot3(state.R), state.p))
        values.insert(v, state.v.copy())
        values.insert(b, gtsam.imuBias.ConstantBias(state.accel_bias, state.gyro_bias))
        return values

    def _bias(self) -> Any:
        return gtsam.imuBias.ConstantBias(self.state.accel_bias, self.state.gyro_bias)

    def _keys(self) -> list[int]:
        return [X(self._node), V(self._node), B(self._node)]

    @property
    def is_sound(self) -> bool:
        """Finite, with positive variances."""
        return bool(np.isfinite(self.state.x).all() and (self.P.diagonal() > 0).all())


def _error_by_tangent(R: Array) -> Array:
    """gtsam's tangents (theta, dp in body; dv; accel bias, gyro bias) -> theta p v bg ba, (15, 15)."""
    T = np.eye(15)
    T[3:6, 3:6] = R
    T[9:15, 9:15] = np.roll(np.eye(6), 3, axis=0)
    return T


def _state_of(values: Any, keys: Any, g: Array) -> State:
    state = State(np.zeros(24))
    pose, bias = values.atPose3(keys[0]), values.atConstantBias(keys[2])
    state.R[:], state.p[:] = pose.rotation().matrix(), pose.translation()
    state.v[:] = values.atVector(keys[1])
    state.gyro_bias[:], state.accel_bias[:] = bias.gyroscope(), bias.accelerometer()
    state.g[:] = g
    return state


def _fill(H: Any, J: Array, R: Array) -> None:
    """Jacobian by the error state (m, 15) -> by gtsam's tangents, one block per key."""
    by_tangent = J @ _error_by_tangent(R)
    for k, (first, last) in enumerate(_BLOCKS):
        H[k] = np.asfortranarray(by_tangent[:, first:last])


def _measurement_error(measurement: Measurement, g: Array) -> Any:
    def error(this: Any, values: Any, H: Any) -> Array:
        state = _state_of(values, this.keys(), g)
        if H is not None:
            _fill(H, measurement.jacobian(state)[:, :15], state.R)
        return measurement.expected(state) - measurement.z

    return error


def _priors(keys: list[int], state: State, P: Array) -> Any:
    """Pose, velocity and biases of the start; what they have in common is left out."""
    graph, Q = gtsam.NonlinearFactorGraph(), np.linalg.inv(_error_by_tangent(state.R))
    turned = Q @ P[:15, :15] @ Q.T
    noises = [gtsam.noiseModel.Gaussian.Covariance(turned[a:b, a:b]) for a, b in _BLOCKS]
    bias = gtsam.imuBias.ConstantBias(state.accel_bias, state.gyro_bias)
    graph.add(gtsam.PriorFactorPose3(keys[0], gtsam.Pose3(gtsam.Rot3(state.R), state.p), noises[0]))
    graph.add(gtsam.PriorFactorVector(keys[1], state.v, noises[1]))
    graph.add(gtsam.PriorFactorConstantBias(keys[2], bias, noises[2]))
    return graph


def _imu_params(noise: ImuNoise, gravity_m_s2: float) -> Any:
    params = gtsam.PreintegrationCombinedParams.MakeSharedU(gravity_m_s2)
    gyro, accel, gyro_walk, accel_walk = (np.eye(3) * density for density in noise.densities)
    params.setGyroscopeCovariance(gyro)
    params.setAccelerometerCovariance(accel)
    params.setBiasOmegaCovariance(gyro_walk)
    params.setBiasAccCovariance(accel_walk)
    params.setIntegrationCovariance(np.eye(3) * 1e-8)
    return params
