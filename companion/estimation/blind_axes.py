"""What a sweep says along axes in which it is blind is noise, and is left out.

Five noisy points of a plain make planes that lean at random, and their sum is no knowledge of the way along it. Nor
is what it does to the other axes: with tilt and height known well, a plane that leans by a hundredth says where on
the plain one is, another way in each sweep. So the blind axes are those of several sweeps, and what is not known
along them blurs the others.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated

import msgspec
import numpy as np

from companion.core.messages import Array
from companion.estimation.normal import LEVER, Normal, turned
from companion.estimation.state import ERROR

_CLEAR = 3.0  # times `below`: of such an axis 99 % would be kept, and nothing is left out
_BACK = np.linalg.inv(LEVER)


class BlindAxesConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Which axes are blind, and what that does to others."""

    below: Annotated[float, msgspec.Meta(ge=0)] = 0.01  # normalised eigenvalue of which half is left out
    renewed: Annotated[float, msgspec.Meta(gt=0, le=1)] = 0.1  # of the mean over sweeps, by each
    lean: Annotated[float, msgspec.Meta(ge=0, le=1)] = 0.01  # rad, by which noise turns the axes of that mean
    drift_m_s2: Annotated[float, msgspec.Meta(ge=0)] = 0.04  # of what the IMU alone says along them: a steady error


class BlindAxes:
    """The mean information (6, 6) of the sweeps since one was blind: turn and shift in odom, in levers, scaled."""

    def __init__(self, config: BlindAxesConfig) -> None:
        self.config = config
        self._mean: Array | None = None
        self._last: Normal | None = None

    def soften(self, normal: Normal, P: Array) -> Normal:
        """It without what is noise: w^4 / (w^4 + below^4) stays of an eigenvalue w. P (6, 6): prior of the pose."""
        self._last, below = normal, self.config.below
        if normal.scale <= 0 or below <= 0 or normal.weakest > _CLEAR * below:
            return normal
        values, vectors = np.linalg.eigh(normal.in_odom / normal.scale if self._mean is None else self._mean)
        axes = turned(normal.R).T @ vectors
        kept = values**4 / (values**4 + below**4)
        spread = ((axes.T @ _BACK @ P @ _BACK @ axes).diagonal() * (kept < 0.5)).sum()
        kept /= 1.0 + np.maximum(values, 0.0) * normal.scale * self.config.lean**2 * spread
        T = _BACK @ (axes * np.sqrt(kept)) @ axes.T @ LEVER
        return replace(normal, H=T @ normal.H @ T.T, g=T @ T @ normal.g)

    @property
    def shift(self) -> Array | None:
        """Projector (3, 3) in odom onto the ways along which the last sweeps were blind; None: there are none."""
        if self._mean is None:
            return None
        values, vectors = np.linalg.eigh(self._mean)
        ways = vectors[3:, values < self.config.below]
        return np.asarray(ways @ ways.T)

    def seen(self) -> None:
        """The last sweep counts in the mean, or ends it; one without a plane says nothing of either."""
        last, c = self._last, self.config
        if last is None or last.scale <= 0:
            return
        if last.weakest > _CLEAR * c.below:
            self._mean = None
            return
        own = last.in_odom / last.scale
        self._mean = own if self._mean is None else self._mean + c.renewed * (own - self._mean)


class BlindDrift:
    """Covariance (9, 9) of position, velocity and a steady acceleration in odom, of what nothing but the IMU says.

    The filter knows its biases and gravity well, and yet not so well that it may go by them for a minute: what LiDAR
    noise says of them along blind axes is believed. As the map's own error, this widens what is said.
    """

    def __init__(self, config: BlindAxesConfig) -> None:
        self._sigma = config.drift_m_s2
        self.C = np.zeros((9, 9))

    def grow(self, shift: Array, dt_s: float) -> None:
        """Another `dt_s` in which the ways of the projector `shift` (3, 3) were blind."""
        values, vectors = np.linalg.eigh(self._sigma**2 * shift - self.C[6:, 6:])
        self.C[6:, 6:] += vectors * np.maximum(values, 0.0) @ vectors.T  # never less: the ways turn a little
        F = np.eye(9)
        F[:3, 3:6] = F[3:6, 6:] = dt_s * np.eye(3)
        F[:3, 6:] = 0.5 * dt_s**2 * np.eye(3)
        self.C = F @ self.C @ F.T

    @property
    def covariance(self) -> Array:
        """Its part of the error state's covariance, (18, 18)."""
        P = np.zeros((ERROR, ERROR))
        P[3:9, 3:9] = self.C[:6, :6]
        return P

    def reset(self) -> None:
        """Nothing is left of it."""
        self.C[:] = 0.0
