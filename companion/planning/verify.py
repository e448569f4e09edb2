"""The last look at a way before it is published: no part of it up to its stop may meet what is seen.

Exact voxel traversal with the hull's radius, whatever the planner, the smoother and the old way claimed. Unknown cells
are free here: the speeds stop before them.
"""

from __future__ import annotations

import numpy as np

from companion.core.messages import Array, LocalMap
from companion.planning.flown import Flown
from companion.planning.polyline import arc_length, project
from companion.planning.space import FieldSpace, part_around

_BEHIND_M = 0.2  # the vehicle's own place is not judged, nor what is behind it


def first_hit_m(flown: Flown, p_odom: Array, local_map: LocalMap, *, radius_m: float) -> float:
    """Arc length of `flown` where its way ahead enters blocked cells before its stop; infinite: nowhere.

    A vehicle that is itself too near to something may leave: the way is judged from its first free point on.
    """
    points, _ = flown.ahead_until_stop
    if len(points) < 2:
        return np.inf
    space = FieldSpace(part_around(local_map, points), radius_m=radius_m, unknown="optimistic")
    s, _ = project(points, p_odom)
    along = arc_length(points)
    ahead = np.flatnonzero((along > s + _BEHIND_M) & space.free(points))
    for n in range(ahead[0] if len(ahead) else len(points), len(points) - 1):
        if not space.segment_free(points[n], points[n + 1]):
            return float(along[n])
    return np.inf
