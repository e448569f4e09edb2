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
    gap_surprises_s: Positive = 1.0  # after a gap, in which sweeps that surprise say nothing of biases
    clock_s: Positive = 0.05  # a longer gap may be none: the clock may have jumped
    surprise: Positive = 8.0  # squared Mahalanobis distance of a sweep's correction; usually 1, seldom 5
    in_a_row: Annotated[int, msgspec.Meta(ge=1)] = 3
    bias_accel_m_s2: Positive = 0.3  # sigma after a jump, at least
    bias_rate_rad_s: Positive = 0.01
    told_s: Positive = 2.0  # how long it is named


def new_buffer(config: ImuDoubtConfig) -> ImuBuffer:
    """A buffer that refuses what a sensor at its stop says."""
    return ImuBuffer(most_rate_rad_s=config.most_rate_rad_s, most_force_m_s2=config.most_force_m_s2)


def gap_covariance(gap_s: float, config: ImuDoubtConfig) -> Array:
    """What a gap adds to that of attitude, position and velocity, (9, 9)."""
    rate, accel = config.gap_rate_rad_s, config.gap_accel_m_s2
    return np.diag(np.repeat([rate * gap_s, 0.5 * accel * gap_s**2, accel * gap_s], 3) ** 2)


def clock_covariance(gap_s: float, v_odom: Array, config: ImuDoubtConfig) -> Array:
    """Of position, (3, 3), while it is not known whether time passed in a gap: v dt was flown, or nothing."""
    return np.outer(v_odom, v_odom) * (gap_s**2 if gap_s > config.clock_s else 0.0)


class ImuDoubt:
    """Widens a filter where its IMU model does not hold."""

    def __init__(self, config: ImuDoubtConfig) -> None:
        self._config = config
        self._surprises = 0
        self._told_s, self._reason = -np.inf, ""
        self._gap_s = -np.inf  # when samples were missing last

    def reason(self, t_s: float) -> str:
        """What is wrong with it, or was within the last seconds; "": nothing."""
        return self._reason if t_s - self._told_s < self._config.told_s else ""

    def gap(self, filter_: Filter, gap_s: float) -> None:
        """No sample for a while, bridged by the next one."""
        if gap_s <= self._config.gap_s:
            return
        filter_.P[:9, :9] += gap_covariance(gap_s, self._config)
        self._gap_s = filter_.t_s
        self._tell(filter_.t_s, f"IMU silent for {gap_s:.2f} s")

    def corrected(self, filter_: Filter) -> None:
        """A sweep has corrected the filter; surprise after surprise means that the biases are not what they were.

        Not so right after a gap, whose surprises are its own.
        """
        c = self._config
        if filter_.t_s - self._gap_s < c.gap_surprises_s:
            return
        self._surprises = self._surprises + 1 if filter_.surprise > c.surprise else 0
        if self._surprises < c.in_a_row:
            return
        self._surprises = 0
        diagonal, least = np.arange(9, 15), np.repeat([c.bias_rate_rad_s, c.bias_accel_m_s2], 3) ** 2
        filter_.P[diagonal, diagonal] = np.maximum(filter_.P[diagonal, diagonal], least)  # again and again adds nothing
        self._tell(filter_.t_s, "IMU bias jumped")

    def _tell(self, t_s: float, reason: str) -> None:
        self._told_s, self._reason = t_s, reason
