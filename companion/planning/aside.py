"""When a vehicle that holds leaves its place: something that moves comes too near."""

from __future__ import annotations

from dataclasses import dataclass

from companion.core.messages import Array
from companion.planning.situation import Situation
from companion.planning.space import Unknown, distance_in, serves


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
            moving_m, still_m = (float(distance_in(one, now.p_odom[None])[0]) for one in (moving, still))
            self.left = moving_m < min(self.radius_m, still_m)
        return self.left and serves(moving, self.unknown)
