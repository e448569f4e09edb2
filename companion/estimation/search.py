"""After a gap: where in the map may the vehicle be? Registration from many starts, the best fit wins."""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated

import msgspec
import numpy as np

from companion.core.geometry import exp_so3
from companion.core.messages import Array
from companion.estimation.features import Registration
from companion.estimation.lines import LineConfig
from companion.estimation.registration import PlaneConfig
from companion.estimation.so3 import orthonormal

Positive = Annotated[float, msgspec.Meta(gt=0)]
Count = Annotated[int, msgspec.Meta(ge=1)]
_DAMPING = np.diag([1e3, 1e3, 1e3, 10.0, 10.0, 10.0])


class SearchConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """When and how."""

    after_s: Positive = 0.45  # without a sweep
    step_m: Positive = 0.8  # between starts: registration finds its way from half of it
    radius_m: Positive = 5.0  # at most; else three standard deviations, and a step at least
    points: Count = 500
    iterations: Count = 5
    plane: PlaneConfig = PlaneConfig(sigma_m=0.15, neighbour_m=1.0)
    line: LineConfig = LineConfig(sigma_m=0.15)  # where edges are registered, too
    fits_m: Positive = 0.06  # a point this near to its plane fits
    agree_share: Annotated[float, msgspec.Meta(ge=0, le=1)] = 0.55  # of the points with a plane must fit
    doubted_share: Annotated[float, msgspec.Meta(ge=0, le=1)] = 0.85  # the same, if clock or IMU are in doubt, too
    hold_s: Annotated[float, msgspec.Meta(ge=0)] = 2.0  # for so long sweeps that do not agree are left out


def search(
    begin: Callable[[], Registration], pose: tuple[Array, Array], *, sigma_m: float, config: SearchConfig
) -> tuple[Array, Array, float]:
    """(R, p, share of points that fit) of the best of many starts around `pose` = (R_odom_body, p_odom).

    `begin` gives a fresh registration of the scan, thinned by `few_of`. Starts lie on a horizontal grid, the
    predicted pose first, which also wins a draw.
    """
    best = (*pose, -1.0)
    for offset in _starts(min(max(3.0 * sigma_m, config.step_m), config.radius_m), config.step_m):
        found = _fit(begin(), (pose[0], pose[1] + offset), config)
        if found[2] > best[2] + 1e-9:
            best = found
    return best


def few_of(points_body: Array, config: SearchConfig) -> Array:
    """`config.points` of the points (N, 3), evenly."""
    few: Array = points_body[np.linspace(0, len(points_body) - 1, min(config.points, len(points_body))).astype(int)]
    return few


def _starts(radius_m: float, step_m: float) -> Array:
    """Offsets (N, 3) on a horizontal grid within a radius, nearest first."""
    count = int(radius_m / step_m)
    line = np.arange(-count, count + 1) * step_m
    x, y = (a.ravel() for a in np.meshgrid(line, line, indexing="ij"))
    inside = np.flatnonzero(x**2 + y**2 <= radius_m**2 + 1e-9)
    order = inside[np.argsort(x[inside] ** 2 + y[inside] ** 2, kind="stable")]
    return np.column_stack([x[order], y[order], np.zeros(len(order))])


def _fit(scan: Registration, start: tuple[Array, Array], config: SearchConfig) -> tuple[Array, Array, float]:
    R, p = start
    for _ in range(config.iterations):
        normal = scan.linearise(R, p)
        if normal.used < 6:
            return R, p, 0.0
        step = np.asarray(np.linalg.solve(normal.H + _DAMPING, normal.g), np.float64)
        R, p = orthonormal(R @ exp_so3(step[:3])), p + step[3:]
        if np.linalg.norm(step[:3]) < 1e-3 and np.linalg.norm(step[3:]) < 1e-2:
            break
    fitting, _, offered = scan.fits(R, p, config.fits_m)
    return R, p, fitting / max(offered, 1)
