"""Smoothing of a valid path: less bending, more clearance, never less safe.

Gradient descent on squared fourth differences plus a hinge on the distance field (the idea of
CHOMP, Ratliff et al. 2009). The result is re-verified exactly; what fails falls back towards
the path that came in.
"""

from __future__ import annotations

import math
from typing import Annotated

import msgspec
import numpy as np
from numba import njit

from companion.core.messages import Array
from companion.planning.grid import trilinear
from companion.planning.polyline import arc_length, cut, length, resample
from companion.planning.space import FieldSpace


class SmoothConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """How a path is smoothed."""

    spacing_m: Annotated[float, msgspec.Meta(gt=0)] = 0.25
    """Distance between points."""
    iterations: Annotated[int, msgspec.Meta(ge=0)] = 150
    """Sweeps over all points."""
    clearance_gain: Annotated[float, msgspec.Meta(ge=0)] = 0.3
    """Share of the missing distance that is made good per sweep."""
    fine_m: Annotated[float, msgspec.Meta(gt=0)] = 0.1
    """Distance between points of the result."""
    roundings: Annotated[int, msgspec.Meta(ge=0)] = 4
    """Binomial filters over the result: no corner at the points of the coarser spacing."""
    wished_extra_m: Annotated[float, msgspec.Meta(ge=0)] = 0.4
    """Distance wished beyond the planning radius."""


def smooth(path: Array, space: FieldSpace, config: SmoothConfig, *, head: Array | None = None) -> Array:
    """Smoothed `path` (N, 3), m, in steps of about fine_m; the ends stay.

    `head` (M, 3) ends where `path` begins: it is put in front unchanged, and the path leaves
    it without a kink. Only `path` is verified in `space`; where it is not free itself, the
    result is `path`.
    """
    fixed = resample(head, config.spacing_m)[:-1] if head is not None and len(head) > 1 else path[:0]
    rough = np.vstack([fixed, resample(path, config.spacing_m)])
    cells = np.ascontiguousarray(space.to_cells(rough))
    wished = space.radius_m + config.wished_extra_m
    _relax(
        space.map.distance_m,
        cells,
        max(len(fixed) + 1, 1),
        config.iterations,
        np.array([wished, config.clearance_gain / space.resolution_m]),
    )
    bent = space.to_odom(cells)
    for share in (1.0, 0.5, 0.25, 0.0):
        mixed = share * bent + (1.0 - share) * rough
        begin = float(arc_length(mixed)[len(fixed)])
        fine = _rounded(resample(mixed, config.fine_m), config.roundings)
        if space.path_free(cut(fine, begin, length(fine))):
            return fine
    return np.vstack([fixed, path])


def _rounded(points: Array, times: int) -> Array:
    """Binomial filter over evenly spaced points; the ends stay."""
    for _ in range(times):
        points = points.copy()
        points[1:-1] = 0.5 * points[1:-1] + 0.25 * (points[:-2] + points[2:])
    return points


@njit(cache=True, nogil=True)
def _relax(field, p, first, iterations, wish):  # type: ignore[no-untyped-def]
    """Sweeps over points first .. N-2 in place; wish = (distance, m; cells moved per m missing)."""
    count, gradient = p.shape[0], np.empty(3)
    for _ in range(iterations):
        for i in range(first, count - 1):
            missing = wish[0] - trilinear(field, p[i], gradient)
            steep = math.sqrt(gradient[0] ** 2 + gradient[1] ** 2 + gradient[2] ** 2)
            push = wish[1] * missing / steep if missing > 0.0 and steep > 1e-9 else 0.0
            for k in range(3):
                second = p[i - 1, k] - 2.0 * p[i, k] + p[i + 1, k]
                if 2 <= i < count - 2:
                    fourth = p[i - 2, k] - 4.0 * p[i - 1, k] + 6.0 * p[i, k] - 4.0 * p[i + 1, k] + p[i + 2, k]
                    p[i, k] += -fourth / 8.0 + 0.02 * second
                else:
                    p[i, k] += second / 4.0
                p[i, k] += push * gradient[k]
