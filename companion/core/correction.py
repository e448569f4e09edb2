"""Where odom lies in map: what the graph says of it, and the way between the two frames."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from companion.core.geometry import IDENTITY_Q, quaternion_conjugate, rotate, yaw_of
from companion.core.messages import Array, SmoothedState


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Correction:
    """Where odom's origin and axes lie in map."""

    p_map_odom: Array  # (3,)
    q_map_odom: Array  # wxyz, (4,)

    @classmethod
    def newest(cls, smoothed: SmoothedState | None) -> Correction:
        """From the graph's newest state; the identity before the first."""
        if smoothed is None:
            return cls(p_map_odom=np.zeros(3), q_map_odom=IDENTITY_Q)
        return cls(p_map_odom=smoothed.p_map_odom, q_map_odom=smoothed.q_map_odom)

    @property
    def yaw(self) -> float:
        """Heading of odom's x in map, rad."""
        return yaw_of(self.q_map_odom)

    def to_map(self, p_odom: Array) -> Array:
        """Points (..., 3), odom -> map."""
        return rotate(self.q_map_odom, p_odom) + self.p_map_odom

    def to_odom(self, p_map: Array) -> Array:
        """Points (..., 3), map -> odom."""
        return rotate(quaternion_conjugate(self.q_map_odom), p_map - self.p_map_odom)
