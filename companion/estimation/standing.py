"""Standing still before the flight: the pose is what it was at the start, whatever the LiDAR's noise says.

Without this, yaw and position wander by what one sweep tells until take-off (in a clearing by centimetres), and
the first map is built from there. Zero-velocity updates after I. Skog et al., "Zero-Velocity Detection", T-BME 2010.

That it moves is known only a moment after it began to (it tips on its legs by some 5 mrad while thrust builds up). So
the filter is then set back to before that moment and run through the IMU again, and sweeps enter the map only when
it is known that the vehicle still stood. Else map and odometry would be tilted by what was held down.
"""

from __future__ import annotations

from collections import deque
from typing import Annotated, TypeVar

import msgspec
import numpy as np

from companion.core.geometry import log_so3
from companion.core.messages import Array
from companion.estimation.filter import Filter
from companion.estimation.normal import Normal
from companion.estimation.propagation import propagate

Positive = Annotated[float, msgspec.Meta(gt=0)]
_WINDOW = 40  # IMU samples over which means are taken, 0.2 s
_LATE_S = 0.4  # after it began to move that is surely known
Sweep = TypeVar("Sweep")


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

    def __init__(self, start: Filter, config: StandingConfig, densities: Array) -> None:
        state = start.state
        self._config, self._densities = config, densities
        self._past: deque[tuple[Array, Array, Array]] = deque()  # x, P, and the IMU from there to the next
        self._sweeps: deque[tuple[float, object]] = deque()
        self._R, self._p = state.R.copy(), state.p.copy()
        self._rest = np.concatenate([state.gyro_bias, state.accel_bias - state.R.T @ state.g])
        self._recent = np.empty((0, 6))
        self.is_over = not config.enabled
        self._sigmas = np.repeat([config.angle_sigma_rad, config.position_sigma_m, config.speed_sigma_m_s], 3)

    def watch(self, imu: Array, filter_: Filter) -> None:
        """Hold the filter where it is, if the pieces (N, 7) of the IMU tell rest."""
        if self.is_over:
            self._set_back(filter_, imu)
            return
        self._recent = np.concatenate([self._recent, imu[:, 1:]])[-_WINDOW:]
        off = self._recent.mean(axis=0) - self._rest
        turns = np.linalg.norm(off[:3]) > self._config.turn_rad_s
        pushed = np.linalg.norm(off[3:]) > self._config.force_m_s2
        self.is_over = len(self._recent) == _WINDOW and bool(turns or pushed)
        if self.is_over:
            self._set_back(filter_, imu)
            return
        filter_.hold(self._R, self._p, sigmas=self._sigmas)
        self._remember(filter_, imu)

    def settled(self, t_s: float, sweep: Sweep) -> Sweep | None:
        """While it stands, the newest sweep from before the last moment, once; later each as it comes."""
        if self.is_over:
            return sweep
        self._sweeps.append((t_s, sweep))
        if self._sweeps[0][0] > t_s - _LATE_S:
            return None
        return self._sweeps.popleft()[1]  # type: ignore[return-value]

    def _remember(self, filter_: Filter, imu: Array) -> None:
        """Keep the last moment: each entry holds the IMU that led to it from the one before."""
        self._past.append((filter_.state.x.copy(), filter_.P.copy(), imu))
        while sum(float(part[:, 0].sum()) for _, _, part in list(self._past)[1:]) > _LATE_S:
            self._past.popleft()

    def _set_back(self, filter_: Filter, imu: Array) -> None:
        """Once: to before the last moment, and from there through the IMU to now."""
        if not self._past:
            return
        x, P, _ = self._past[0]
        pieces = np.concatenate([*(part for _, _, part in list(self._past)[1:]), imu])
        filter_.state.x[:], filter_.P = x, P
        propagate(filter_.state, filter_.P, pieces, self._densities, t_s=0.0)
        self._past.clear()

    def seen(self, normal: Normal) -> None:
        """Over if a sweep says that the vehicle is elsewhere."""
        if self.is_over:
            return
        off = np.concatenate([log_so3(normal.R.T @ self._R), self._p - normal.p])
        gradient = normal.H @ off - normal.g  # of the sweep's cost at the held pose
        self.is_over = bool(gradient @ np.linalg.pinv(normal.H) @ gradient > self._config.lidar_chi2)
