"""What planning knows of the vehicle and its surroundings at one moment."""

from __future__ import annotations

from dataclasses import dataclass

from companion.core.messages import Array, Array32, LocalMap


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Situation:
    """Where the vehicle is and what is known around it."""

    p_odom: Array
    v_odom: Array
    local_map: LocalMap  # with what moves
    still_map: LocalMap  # without
    ground: Array32 | None  # filled, (X, Y)
    ground_z: float  # last seen under the vehicle
