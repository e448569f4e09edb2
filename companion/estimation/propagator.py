"""From the newest filter state through the IMU to now: the odometry that control flies on."""

from __future__ import annotations

import math

import numpy as np

from companion.core.geometry import quaternion_from_rotation, rotation_from_quaternion
from companion.core.messages import Array, ImuSample, LioState, Odometry
from companion.estimation.config import PropagatorConfig
from companion.estimation.health import judge
from companion.estimation.imu_doubt import ImuDoubtConfig, clock_covariance, gap_covariance, new_buffer
from companion.estimation.propagation import ImuNoise, propagate
from companion.estimation.state import STATE, State


class Propagator:
    """Dead reckoning between corrections; a correction is taken at once and in full.

    It is not smoothed: a filter step of millimetres at 25 Hz is below what a position loop
    feels, and smoothing would give the velocity a lag.
    """

    def __init__(self, config: PropagatorConfig, noise: ImuNoise, doubt: ImuDoubtConfig) -> None:
        self._config, self._densities, self._doubt = config, noise.densities, doubt
        self._imu = new_buffer(doubt)
        self._state: State | None = None
        self._P = np.empty((0, 0))
        self._time_ns = self._base_ns = self._scan_ns = 0
        self._scan_p = np.zeros(3)
        self._doubts = ""
        self._resets = -1  # the first start is none
        self._published_ns = -(2**62)

    def correct(self, state: LioState) -> None:
        """Begin anew from a filter state and run through the IMU samples that came since."""
        if state.source == "start":
            self._resets += 1
        elif self._state is None or state.stamp_ns < self._base_ns:
            return  # not started, or older than what is known
        if state.source != "camera":
            self._scan_ns, self._scan_p = state.stamp_ns, state.p_odom
        self._doubts = state.doubts
        before = self._state.p.copy() if self._state is not None else state.p_odom
        self._state, self._P = _unpack(state), state.covariance.copy()
        self._time_ns = self._base_ns = state.stamp_ns
        if len(self._imu):
            self._run_to(self._imu.newest_ns, self._imu.longest_gap_s(self._time_ns, self._imu.newest_ns))
        if state.source != "start" and np.linalg.norm(self._state.p - before) > self._config.reset_from_m:
            self._resets += 1

    def advance(self, sample: ImuSample) -> Odometry | None:
        """Take an IMU sample; the odometry at its stamp when one is due."""
        if not self._imu.append(sample) or self._state is None:
            return None
        self._run_to(sample.stamp_ns, self._imu.newest_gap_s)
        half_ns = 500_000_000 / self._config.rate_hz
        if sample.stamp_ns < self._time_ns or sample.stamp_ns - self._published_ns < 1.5 * half_ns:
            return None
        self._published_ns = sample.stamp_ns
        return self._odometry(self._state)

    def _run_to(self, stamp_ns: int, gap_s: float) -> None:
        pieces = self._imu.between(self._time_ns, stamp_ns)
        if len(pieces) and self._state is not None:
            propagate(self._state, self._P, pieces, self._densities, t_s=0.0)
            if gap_s > self._doubt.gap_s:
                self._P[:9, :9] += gap_covariance(gap_s, self._doubt)
                self._P[3:6, 3:6] += clock_covariance(gap_s, self._state.v, self._doubt)
            self._time_ns = stamp_ns

    def _odometry(self, state: State) -> Odometry:
        variance = self._pose_variance(state)
        sigma_m = float(np.sqrt(variance[3:].max()))
        lidar_age_s = (self._time_ns - self._scan_ns) * 1e-9
        config = self._config.health
        health, reason = judge(sigma_m=sigma_m, lidar_age_s=lidar_age_s, doubts=self._doubts, config=config)
        blind = self._time_ns - self._base_ns > self._config.blind_after_s * 1e9 or health == "lost"
        return Odometry(
            stamp_ns=self._time_ns,
            p_odom=state.p.copy(),
            q_odom_body=quaternion_from_rotation(state.R),
            v_odom=state.v.copy(),
            omega_body=self._imu.newest_rate - state.gyro_bias,
            pose_variance=variance,
            velocity_variance=self._P.diagonal()[6:9].copy(),
            measured_ns=self._base_ns,
            quality=0.0 if blind else math.exp(-sigma_m / config.quality_sigma_m),
            reset_counter=self._resets,
            health=health,
            health_reason=reason,
        )

    def _pose_variance(self, state: State) -> Array:
        """The filter's and the map's, and for position a share of the way since the last scan."""
        variance = self._P.diagonal()[:6].copy()
        drift_m = self._config.drift_share * float(np.linalg.norm(state.p - self._scan_p))
        variance[3:] = (np.sqrt(variance[3:]) + drift_m) ** 2
        return variance


def _unpack(message: LioState) -> State:
    x = np.empty(STATE)
    x[:9] = rotation_from_quaternion(message.q_odom_body).ravel()
    x[9:12], x[12:15] = message.p_odom, message.v_odom
    x[15:18], x[18:21], x[21:24] = message.gyro_bias_body, message.accel_bias_body, message.gravity_odom
    return State(x)
