"""What the filter cannot know: how far its own map has drifted.

The filter measures against a map that it takes as true. What a sweep adds to the map carries the error of that
sweep's pose, and later sweeps are matched against it: the map does a random walk.

Yaw and position walk by the error of a pose, taken in the share in which the map is new. They walk together, since
the way ahead is laid along the yaw that there is.

Roll, pitch and height walk by what a single sweep tells of them, not by what the filter believes: that is the mean of
many sweeps against a map that they all take as true, and beside it gravity has no say. Noise n of a sweep's tilt,
covariance N, of which the filter takes K n and forgets K of what it has, turns the map by s K n (1 + (1 - K) + ...)
= s n, with s the share of the room in sight that is new (by less, where K is not well above s). So each sweep adds
s^2 N. A LiDAR that sees far tells the tilt well and needs the new ground little; one that sees 8 m of a plain has only
a strip of it, and the map bends.

The anchors that a camera lays while no sweep comes take roll and pitch of the pose, too. And a camera measures its way
by the height above ground: a height that is off by a hundredth makes the way off by a hundredth.

Source: the consider state of Schmidt ("Application of state-space methods to navigation problems", 1966): it widens
what is said, and corrects nothing.
"""

from __future__ import annotations

from typing import Annotated

import msgspec
import numpy as np

from companion.core.geometry import skew
from companion.core.messages import Array
from companion.estimation.normal import LEVER, Normal
from companion.estimation.state import ERROR, State

_LEANS = np.ix_([0, 1, 5], [0, 1, 5])  # roll, pitch and height of turn and shift in odom
_LEVERS = LEVER[_LEANS]
_SEEN = 0.003  # normalised eigenvalue below which sweeps do not lay the map by it: the camera or the IMU does
_RENEWED = 0.1  # of the mean over sweeps, by each


class MapErrorConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """How fast it is taken to drift."""

    share: Annotated[float, msgspec.Meta(ge=0)] = (
        0.1  # of a pose's covariance, per map renewed: errors of sweeps average out
    )
    track_share: Annotated[float, msgspec.Meta(ge=0)] = 3.0  # the same, of the camera's anchors
    lean: Annotated[float, msgspec.Meta(ge=0)] = 1.0  # of a sweep's own covariance of tilt and height; 1: as derived


class MapError:
    """Covariance (6, 6) of turn (rad) and position (m), both in odom, of the map at the vehicle."""

    def __init__(self) -> None:
        self.C = np.zeros((6, 6))
        self._p: Array | None = None
        self._told: Array | None = None  # what a sweep tells, in the mean: turn and shift in odom, in levers

    def move(self, p: Array, above_m: float = np.inf) -> None:
        """The vehicle went to p (3,): what was a turn becomes position across the way.

        `above_m`: how high above what a camera measured the way against; as much as that height is wrong, the way is.
        """
        if self._p is not None:
            A = np.eye(6)
            A[3:, :3] = -skew(p - self._p)
            A[3:5, 5] = (p - self._p)[:2] / above_m
            self.C = A @ self.C @ A.T
        self._p = p.copy()

    def extend(self, state: State, P: Array, share: float, *, tilts: bool = False) -> None:
        """`share` of what was seen is new to the map and got yaw and position of the pose, P (18, 18); `tilts`: all."""
        J = np.zeros((6, 6))
        J[2, :3] = state.R[2]  # yaw is the turn about odom's vertical
        if tilts:
            J[:2, :3] = state.R[:2]
        J[3:, 3:] = np.eye(3)
        self.C = self.C + share * J @ P[:6, :6] @ J.T

    def lean(self, swept: Normal, share: float, factor: float) -> None:
        """`share` of the room that a sweep met is new to the map, and leans by what one sweep tells: (s^2 N) `factor`.

        N is taken from the mean information of sweeps, as a filter's gain is, with yaw and the way given.
        """
        own = swept.in_odom
        self._told = own if self._told is None else self._told + _RENEWED * (own - self._told)
        scale = float(np.trace(self._told[3:, 3:]))
        values, axes = np.linalg.eigh(self._told[_LEANS] / scale)
        variances = factor * share**2 / scale * values**3 / (values**4 + _SEEN**4)
        self.C[_LEANS] += _LEVERS @ (axes * variances) @ axes.T @ _LEVERS

    def covariance(self, state: State) -> Array:
        """Its part of the error state's covariance, (18, 18): also the velocity turns with the map."""
        J = np.zeros((ERROR, 6))
        J[:3, :3] = state.R.T
        J[3:6, 3:] = np.eye(3)
        J[6:9, :3] = -skew(state.v)
        return J @ self.C @ J.T

    def reset(self) -> None:
        """Nothing is left of it."""
        self.C[:] = 0.0
