"""Measurements of the state for any filter: what is expected of it, and how that changes with the error state.

A filter asks for `z`, `noise`, `expected` and, if it linearises, `jacobian`: a new sensor is one
class here, and every filter takes it.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from companion.core.geometry import skew
from companion.core.messages import Array
from companion.estimation.state import ERROR, State

_THETA, _P, _V = slice(0, 3), slice(3, 6), slice(6, 9)


class Measurement(Protocol):
    """z = expected(state) + noise, m figures that can be subtracted."""

    @property
    def z(self) -> Array:
        """What was measured, (m,)."""
        ...

    @property
    def noise(self) -> Array:
        """Its covariance, (m, m)."""
        ...

    def expected(self, state: State) -> Array:
        """What would be measured at `state` without noise, (m,)."""
        ...

    def jacobian(self, state: State) -> Array:
        """d expected / d error, (m, 18), in the order of `State.minus`."""
        ...


@dataclass(frozen=True, slots=True)
class PositionFix:
    """Position of an antenna in the world: RTK or GPS."""

    z: Array  # p_world of the antenna, m, (3,)
    noise: Array  # (3, 3), m2
    antenna_body: Array = field(default_factory=lambda: np.zeros(3))  # lever arm, m, (3,)

    def expected(self, state: State) -> Array:
        """p + R l, (3,)."""
        antenna: Array = state.p + state.R @ self.antenna_body
        return antenna

    def jacobian(self, state: State) -> Array:
        """(3, 18)."""
        J = np.zeros((3, ERROR))
        J[:, _THETA] = -state.R @ skew(self.antenna_body)
        J[:, _P] = np.eye(3)
        return J


@dataclass(frozen=True, slots=True)
class VelocityFix:
    """Velocity in the world, as GNSS receivers give it."""

    z: Array  # v_world, m/s, (3,)
    noise: Array  # (3, 3)

    def expected(self, state: State) -> Array:
        """v, (3,)."""
        return state.v.copy()

    def jacobian(self, state: State) -> Array:
        """(3, 18)."""
        J = np.zeros((3, ERROR))
        J[:, _V] = np.eye(3)
        return J


@dataclass(frozen=True, slots=True)
class RangeBelow:
    """Range finder along body -z over flat ground."""

    z: Array  # m, (1,)
    noise: Array  # (1, 1)
    ground_m: float = 0.0  # height of the ground in the world

    def expected(self, state: State) -> Array:
        """Height over the cosine of the tilt, (1,)."""
        return np.array([(state.p[2] - self.ground_m) / state.R[2, 2]])

    def jacobian(self, state: State) -> Array:
        """(1, 18)."""
        J = np.zeros((1, ERROR))
        J[0, _THETA] = -self.expected(state)[0] / state.R[2, 2] * _cosine_by_theta(state)
        J[0, 5] = 1.0 / state.R[2, 2]
        return J


@dataclass(frozen=True, slots=True)
class GroundFlow:
    """Optical flow of a downward camera over flat ground, without the share of the body's rotation.

    Flow is body velocity over the range along the optical axis; its sign here is that of the
    velocity. Source: D. Honegger et al., "An Open Source and Open Hardware Embedded Metric
    Optical Flow CMOS Camera", ICRA 2013, eq. 5.
    """

    z: Array  # v_body x and y over range, 1/s, (2,)
    noise: Array  # (2, 2)
    ground_m: float = 0.0

    def expected(self, state: State) -> Array:
        """(2,)."""
        rate: Array = (state.R.T @ state.v)[:2] / self._range_m(state)
        return rate

    def jacobian(self, state: State) -> Array:
        """(2, 18)."""
        v_body, range_m = state.R.T @ state.v, self._range_m(state)
        J = np.zeros((2, ERROR))
        J[:, _THETA] = skew(v_body)[:2] / range_m
        J[:, _THETA] += np.outer(v_body[:2], _cosine_by_theta(state)) / (range_m * state.R[2, 2])
        J[:, _V] = state.R.T[:2] / range_m
        J[:, 5] = -v_body[:2] / (range_m**2 * state.R[2, 2])
        return J

    def _range_m(self, state: State) -> float:
        return float((state.p[2] - self.ground_m) / state.R[2, 2])


def _cosine_by_theta(state: State) -> Array:
    """d R[2, 2] / d theta_body, (3,)."""
    return np.array([-state.R[2, 1], state.R[2, 0], 0.0])
