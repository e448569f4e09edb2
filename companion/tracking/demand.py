"""What a tracking law asks for at one instant, before limits."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from companion.core.messages import Array
from companion.tracking.path import PathPoint


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Demand:
    """All in the path's frame."""

    here: PathPoint  # nearest to the vehicle
    place: Array  # place to be, (3,)
    v: Array  # along the path, m/s, (3,)
    a: Array  # feed-forward, m/s2, (3,)


def across(vector: Array, tangent: Array) -> Array:
    """What of a vector (3,) is not along a unit tangent (3,)."""
    rest: Array = vector - float(vector @ tangent) * tangent
    return rest


def limited(vector: Array, most: float) -> Array:
    """The vector (3,), shortened to a norm of at most `most`."""
    size = float(np.linalg.norm(vector))
    return vector if size <= most else vector * (most / size)
