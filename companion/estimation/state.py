"""The filter's state as one packed vector, so that kernels take it whole.

Layout of `x` (24,): R_odom_body row by row (9), p_odom (3), v_odom (3), gyro bias (3),
accelerometer bias (3), gravity_odom (3). The error state (18,) is theta_body (R Exp(theta)),
p, v, bg, ba, g.
"""

from __future__ import annotations

import numpy as np

from companion.core.geometry import exp_so3, log_so3
from companion.core.messages import Array
from companion.estimation.so3 import orthonormal

STATE = 24
ERROR = 18


class State:
    """Named views into the packed vector; writing to a view writes to the state."""

    __slots__ = ("R", "accel_bias", "g", "gyro_bias", "p", "v", "x")

    def __init__(self, x: Array) -> None:
        self.x = x
        self.R = x[:9].reshape(3, 3)
        self.p, self.v = x[9:12], x[12:15]
        self.gyro_bias, self.accel_bias, self.g = x[15:18], x[18:21], x[21:24]

    @classmethod
    def at_rest(cls, gravity_m_s2: float) -> State:
        """Level at the origin."""
        x = np.zeros(STATE)
        x[:9] = np.eye(3).ravel()
        x[23] = -gravity_m_s2
        return cls(x)

    def copy(self) -> State:
        """An independent copy."""
        return State(self.x.copy())

    def retract(self, error: Array) -> None:
        """Add an error state (18,) in place."""
        self.R[:] = orthonormal(self.R @ exp_so3(error[:3]))
        self.x[9:] += error[3:]

    def minus(self, other: State) -> Array:
        """The error state (18,) that takes `other` here."""
        error = np.empty(ERROR)
        error[:3] = log_so3(other.R.T @ self.R)
        error[3:] = self.x[9:] - other.x[9:]
        return error
