"""Standing still before the flight: the pose is what it was at the start, whatever the LiDAR's noise says.

Without this, yaw and position wander by what one sweep tells until take-off (in a clearing by centimetres), and
the first map is built from there. Zero-velocity updates after I. Skog et al., "Zero-Velocity Detection", T-BME 2010.
"""

from __future__ import annotations

from typing import Annotated

import msgspec
import numpy as np

from companion.core.geometry import log_so3
from companion.core.messages import Array
from companion.estimation.filter import Filter
from companion.estimation.normal import Normal

Positive = Annotated[float, msgspec.Meta(gt=0)]
_WINDOW = 40  # IMU samples over which means are taken, 0.2 s


class StandingConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """How firmly a vehicle that has not moved since the start is held where it is, and what tells that it moves."""

    enabled: bool = True
    angle_sigma_rad: Positive = 3e-4
    position_sigma_m: Positive = 1e-3
    speed_sigma_m_s: Positive = 5e-3
    turn_rad_s: Positive = 0.02  # mean rate over 0.2 s beyond the bias of the start
    force_m_s2: Positive = 0.25  # mean specific force beyond that of the start
    lidar_chi2: Positive = 100.0  # of the held pose, in the eyes of a sweep


class Standing:
    """Holds the filter until the vehicle first moves; then never again."""

    def __init__(self, start: Filter, config: StandingConfig) -> None:
        state = start.state
        self._config = config
        self._R, self._p = state.R.copy(), state.p.copy()
        self._rest = np.concatenate([state.gyro_bias, state.accel_bias - state.R.T @ state.g])
        self._recent = np.empty((0, 6))
        self.is_over = not config.enabled
        self._sigmas = np.repeat([config.angle_sigma_rad, config.position_sigma_m, config.speed_sigma_m_s], 3)

    def watch(self, imu: Array, filter_: Filter) -> None:
        """Hold the filter where it is, if the pieces (N, 7) of the IMU tell rest."""
        if self.is_over:
            return
        self._recent = np.concatenate([self._recent, imu[:, 1:]])[-_WINDOW:]
        off = self._recent.mean(axis=0) - self._rest
        turns = np.linalg.norm(off[:3]) > self._config.turn_rad_s
        pushed = np.linalg.norm(off[3:]) > self._config.force_m_s2
        self.is_over = len(self._recent) == _WINDOW and bool(turns or pushed)
        if not self.is_over:
            filter_.hold(self._R, self._p, sigmas=self._sigmas)

    def seen(self, normal: Normal) -> None:
        """Over if a sweep says that the vehicle is elsewhere."""
        if self.is_over:
            return
        off = np.concatenate([log_so3(normal.R.T @ self._R), self._p - normal.p])
        gradient = normal.H @ off - normal.g  # of the sweep's cost at the held pose
        self.is_over = bool(gradient @ np.linalg.pinv(normal.H) @ gradient > self._config.lidar_chi2)
