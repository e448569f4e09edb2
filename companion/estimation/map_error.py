"""What the filter cannot know: how far its own map has drifted.

The filter measures against a map that it takes as true. What a sweep adds to the map carries the error of that
sweep's pose, and later sweeps are matched against it: yaw and position do a random walk whose step is the error of
one pose, taken in the share in which the map is new. Tilt does not: gravity is measured. Yaw and position walk
together, since the way ahead is laid along the yaw that there is.

Source: the consider state of Schmidt ("Application of state-space methods to navigation problems", 1966): it widens
what is said, and corrects nothing.
"""

from __future__ import annotations

from typing import Annotated

import msgspec
import numpy as np

from companion.core.geometry import skew
from companion.core.messages import Array
from companion.estimation.state import ERROR, State


class MapErrorConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """How fast it is taken to drift."""

    share: Annotated[float, msgspec.Meta(ge=0)] = (
        0.1  # of a pose's covariance, per map renewed: errors of sweeps average out
    )
    track_share: Annotated[float, msgspec.Meta(ge=0)] = 3.0  # the same, of the camera's anchors


class MapError:
    """Covariance (4, 4) of yaw about the vertical (rad) and position in odom (m) of the map at the vehicle."""

    def __init__(self) -> None:
        self.C = np.zeros((4, 4))
        self._p: Array | None = None

    def move(self, p: Array) -> None:
        """The vehicle went to p (3,): what was yaw becomes position across the way."""
        if self._p is not None:
            x, y, _ = p - self._p
            A = np.eye(4)
            A[1, 0], A[2, 0] = -y, x
            self.C = A @ self.C @ A.T
        self._p = p.copy()

    def extend(self, state: State, P: Array, share: float) -> None:
        """`share` of what was seen is new to the map and got the error of the pose, P (18, 18)."""
        J = np.zeros((4, 6))
        J[0, :3] = state.R[2]  # yaw is the turn about odom's vertical
        J[1:, 3:] = np.eye(3)
        self.C = self.C + share * J @ P[:6, :6] @ J.T

    def covariance(self, state: State) -> Array:
        """Its part of the error state's covariance, (18, 18): also the velocity turns with the yaw."""
        J = np.zeros((ERROR, 4))
        J[:3, 0] = state.R[2]
        J[3:6, 1:] = np.eye(3)
        J[6:9, 0] = skew(np.array([0.0, 0.0, 1.0])) @ state.v
        return J @ self.C @ J.T

    def reset(self) -> None:
        """Nothing is left of it."""
        self.C[:] = 0.0
