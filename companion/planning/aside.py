"""When a vehicle that holds leaves its place: something that moves comes too near."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from companion.core.messages import Array
from companion.planning.grid import sample_field
from companion.planning.situation import Situation
from companion.planning.space import Unknown, serves


@dataclass(slots=True, eq=False)
class Aside:
    """The place to hold; once it was left, the way is planned anew with every map, out of the way and back."""

    held_odom: Array  # (3,)
    radius_m: float  # nearer than this nothing that moves may come
    unknown: Unknown
    left: bool = False

    def is_left(self, now: Situation) -> bool:
        """Is, or was, what moves too near to the vehicle, or about to be? False while the map serves no plan."""
        moving, still = now.local_map, now.still_map
        if not self.left and moving is not still:
            cells = np.ascontiguousarray((now.p_odom - still.origin_odom)[None] / still.resolution_m)
            near_m = [float(sample_field(one.distance_m, cells)[0]) for one in (moving, still)]
            self.left = near_m[0] < min(self.radius_m, near_m[1])
        return self.left and serves(moving, self.unknown)
