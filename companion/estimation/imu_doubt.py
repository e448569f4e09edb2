"""When the IMU cannot be believed: samples are missing, or its biases have jumped."""

from __future__ import annotations

from typing import Annotated

import msgspec
import numpy as np

from companion.core.messages import Array
from companion.estimation.filter import Filter
from companion.estimation.imu_buffer import ImuBuffer

Positive = Annotated[float, msgspec.Meta(gt=0)]


class ImuDoubtConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """What is unknown in a gap, and what tells a jump."""

    most_rate_rad_s: Positive = 30.0  # from here on the sensor is at its stop (2000 deg/s are 34.9)
    most_force_m_s2: Positive = 150.0  # (16 g are 157)
    gap_s: Positive = 0.03  # between samples: longer is a gap
    gap_accel_m_s2: Positive = 3.0  # sigma of what a gap hides
    gap_rate_rad_s: Positive = 0.5
    clock_s: Positive = 0.1  # a longer gap may be none: the clock jumped, and the way flown in it is none, or twice
    surprise: Positive = 8.0  # squared Mahalanobis distance of a sweep's correction; usually 1, seldom 5
    in_a_row: Annotated[int, msgspec.Meta(ge=1)] = 3
    bias_accel_m_s2: Positive = 0.3  # sigma that is added after a jump
    bias_rate_rad_s: Positive = 0.01
    told_s: Positive = 2.0  # how long it is named


def new_buffer(config: ImuDoubtConfig) -> ImuBuffer:
    """A buffer that refuses what a sensor at its stop says."""
    return ImuBuffer(most_rate_rad_s=config.most_rate_rad_s, most_force_m_s2=config.most_force_m_s2)


def gap_covariance(gap_s: float, v_odom: Array, config: ImuDoubtConfig) -> Array:
    """What a gap adds to that of attitude, position and velocity, (9, 9); where a clock may have jumped, also the way.

    Stamps alone do not tell silence from a clock that was set: with the one v dt was flown, with the other nothing.
    """
    rate, accel = config.gap_rate_rad_s, config.gap_accel_m_s2
    added = np.diag(np.repeat([rate * gap_s, 0.5 * accel * gap_s**2, accel * gap_s], 3) ** 2)
    if gap_s > config.clock_s:
        added[3:6, 3:6] += np.outer(v_odom, v_odom) * gap_s**2
    return added


class ImuDoubt:
    """Widens a filter where its IMU model does not hold."""

    def __init__(self, config: ImuDoubtConfig) -> None:
        self._config = config
        self._surprises = 0
        self._told_s, self._reason = -np.inf, ""

    def reason(self, t_s: float) -> str:
        """What is wrong with it, or was within the last seconds; "": nothing."""
        return self._reason if t_s - self._told_s < self._config.told_s else ""

    def gap(self, filter_: Filter, gap_s: float) -> None:
        """No sample for a while, bridged by the next one."""
        if gap_s <= self._config.gap_s:
            return
        filter_.P[:9, :9] += gap_covariance(gap_s, filter_.state.v, self._config)
        self._tell(filter_.t_s, f"IMU silent for {gap_s:.2f} s")

    def corrected(self, filter_: Filter) -> None:
        """A sweep has corrected the filter; surprise after surprise means that the biases are not what they were."""
        c = self._config
        self._surprises = self._surprises + 1 if filter_.surprise > c.surprise else 0
        if self._surprises < c.in_a_row:
            return
        self._surprises = 0
        filter_.P[np.arange(9, 15), np.arange(9, 15)] += np.repeat([c.bias_rate_rad_s, c.bias_accel_m_s2], 3) ** 2
        self._tell(filter_.t_s, "IMU bias jumped")

    def _tell(self, t_s: float, reason: str) -> None:
        self._told_s, self._reason = t_s, reason
