"""Start at rest: level attitude, gyro bias and the accelerometer's share of |g|."""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec
import numpy as np

from companion.core.messages import Array
from companion.estimation.filter import Filter, StartSigmas, start_covariance
from companion.estimation.filters.unscented import UnscentedFilter
from companion.estimation.so3 import tilt_free
from companion.estimation.state import State

Positive = Annotated[float, msgspec.Meta(gt=0)]


class StartConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """When the vehicle counts as standing still, what is then assumed, and the filter that begins there."""

    filter: Literal["ekf", "ukf"] = "ekf"  # error-state, linearised; or unscented: 36 sigma points
    rest_s: Positive = 1.0  # stand still for this long
    gyro_spread_rad_s: Positive = 0.03  # largest standard deviation of an axis
    accel_spread_m_s2: Positive = 0.3
    turn_rad_s: Positive = 0.1  # largest mean rate that may be a bias
    gravity_m_s2: Positive = 9.80665
    accel_bias_sigma_m_s2: Positive = 0.1  # horizontal: 0.1 is 0.6 deg of tilt


def is_at_rest(samples: Array, config: StartConfig) -> bool:
    """Whether rate and specific force (N, 6) may come from a vehicle that stands still."""
    spread, mean = samples.std(axis=0), samples.mean(axis=0)
    quiet = (spread[:3] < config.gyro_spread_rad_s).all() and (spread[3:] < config.accel_spread_m_s2).all()
    upright = abs(float(np.linalg.norm(mean[3:])) - config.gravity_m_s2) < 1.0
    return bool(quiet and upright and np.linalg.norm(mean[:3]) < config.turn_rad_s)


def start_filter(samples: Array, config: StartConfig, *, t_s: float) -> Filter:
    """Filter from rate and specific force at rest (N, 6): z up, yaw 0, at the origin.

    Level to within accelerometer bias / g, which the gravity state then finds out in flight.
    """
    rate, force = samples[:, :3].mean(axis=0), samples[:, 3:].mean(axis=0)
    state = State.at_rest(config.gravity_m_s2)
    state.R[:] = _without_yaw(tilt_free(force))
    state.gyro_bias[:] = rate
    state.accel_bias[:] = force * (1.0 - config.gravity_m_s2 / np.linalg.norm(force))
    P = start_covariance(state.R, tilt_sigma_m_s2=config.accel_bias_sigma_m_s2, sigmas=StartSigmas())
    kind = UnscentedFilter if config.filter == "ukf" else Filter
    return kind(state, P, t_s)


def _without_yaw(R: Array) -> Array:
    heading = np.arctan2(R[1, 0], R[0, 0])
    c, s = np.cos(heading), np.sin(heading)
    turned: Array = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]]) @ R
    return turned
