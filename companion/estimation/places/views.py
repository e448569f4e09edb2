"""What a place looks like where no trunks stand: how far one sees, all around, in bands of height.

The descriptor of a place is the nearest range in each sector of azimuth and band of height, as
a panorama. It can be computed for any point of a map, also one where nobody has been. Two
panoramas are compared at every turn, as Scan Context does with its columns (G. Kim and A. Kim,
"Scan Context", IROS 2018); ranges in place of heights, because tunnels and halls have roofs.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

import msgspec
import numpy as np
from numba import njit

from companion.core.messages import Array, Array32

Positive = Annotated[float, msgspec.Meta(gt=0)]
Count = Annotated[int, msgspec.Meta(ge=1)]


class ViewConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The panorama, and how many places are worth a closer look."""

    sectors: Annotated[int, msgspec.Meta(ge=12, le=720)] = 90
    lowest_m: float = -0.9  # of the bands, from the height of the eye
    band_m: Positive = 0.4
    bands: Annotated[int, msgspec.Meta(ge=1, le=16)] = 8
    nearest_m: Positive = 0.25  # an eye this near to something is in it
    farthest_m: Positive = 16.0
    clip: Positive = 0.5  # of the difference of logarithms in one cell
    most_places: Count = 8
    elsewhere_m: Positive = 1.5  # places nearer to each other count as one


@dataclass(frozen=True, slots=True, eq=False)
class Sight:
    """A place that looks like the view: point_map = R(yaw) point_view + p_map, levelled."""

    p_map: Array  # (3,), m
    yaw: float
    unlike: float  # mean clipped difference of logarithms, 0 to `clip`


def panoramas(points: Array32, eyes: Array, config: ViewConfig) -> Array32:
    """Logarithms of the nearest ranges (M, bands, sectors), for eyes (M, 3) among points (N, 3), z up, m.

    A cell that nothing lies in shows `farthest_m`; an eye with a point nearer than `nearest_m` is all NaN.
    """
    order = np.argsort(points[:, 0], kind="stable")
    near = np.full((len(eyes), config.bands, config.sectors), config.farthest_m, np.float32)
    limits = (config.lowest_m, config.band_m, config.nearest_m, config.farthest_m)
    _look(np.ascontiguousarray(points[order], np.float32), np.ascontiguousarray(eyes, np.float64), limits, near)
    return np.log(near)


def sights(known: Array32, eyes: Array, view: Array32, config: ViewConfig) -> list[Sight]:
    """The places among `eyes` (M, 3) whose panoramas (M, B, S) are most like that of the view (B, S), best first."""
    unlike, turn = np.full(len(eyes), np.inf), np.zeros(len(eyes), np.int64)
    if not len(eyes) or np.isnan(view).any():
        return []
    _compare(known, view, config.clip, unlike, turn)
    found: list[Sight] = []
    for n in np.argsort(unlike, kind="stable"):
        if len(found) == config.most_places or not np.isfinite(unlike[n]):
            break
        if all(np.linalg.norm(s.p_map - eyes[n]) >= config.elsewhere_m for s in found):
            yaw = 2.0 * math.pi * turn[n] / config.sectors
            found.append(Sight(eyes[n], math.remainder(yaw, 2.0 * math.pi), float(unlike[n])))
    return found


def eyes_about(p: Array, radius_m: float, step_m: float) -> Array:
    """A level grid (M, 3) of eyes about a point (3,)."""
    line = np.arange(-math.floor(radius_m / step_m), math.floor(radius_m / step_m) + 1) * step_m
    grid = np.stack(np.meshgrid(line, line, [0.0], indexing="ij"), axis=-1).reshape(-1, 3)
    return np.asarray(p + grid[np.hypot(grid[:, 0], grid[:, 1]) <= radius_m])


def panorama(points: Array32, config: ViewConfig) -> Array32:
    """That of the eye at the origin, (B, S)."""
    return np.asarray(panoramas(points, np.zeros((1, 3)), config)[0])


@njit(cache=True, nogil=True)
def _look(points, eyes, limits, near):  # type: ignore[no-untyped-def]
    """Points are ordered by x: those out of reach are never looked at."""
    lowest, band_m, nearest, farthest = limits
    bands, sectors = near.shape[1], near.shape[2]
    per_rad = sectors / (2.0 * math.pi)
    x_of = points[:, 0]
    for m in range(eyes.shape[0]):
        first = np.searchsorted(x_of, np.float32(eyes[m, 0] - farthest))
        blocked = False
        for n in range(first, points.shape[0]):
            dx = points[n, 0] - eyes[m, 0]
            if dx > farthest:
                break
            dy, dz = points[n, 1] - eyes[m, 1], points[n, 2] - eyes[m, 2]
            b = math.floor((dz - lowest) / band_m)
            r2 = dx * dx + dy * dy
            if b < 0 or b >= bands or r2 >= farthest * farthest:
                continue
            if r2 + dz * dz < nearest * nearest:
                blocked = True
                break
            s = int((math.atan2(dy, dx) + math.pi) * per_rad) % sectors
            r = math.sqrt(r2)
            if r < near[m, b, s]:
                near[m, b, s] = max(r, nearest)
        if blocked:
            near[m] = np.nan


@njit(cache=True, nogil=True)
def _compare(known, view, clip, unlike, turn):  # type: ignore[no-untyped-def]
    """Best turn of the view, in sectors, against each known panorama; gives up on a turn that cannot win."""
    bands, sectors = view.shape
    for m in range(known.shape[0]):
        if np.isnan(known[m, 0, 0]):
            continue
        best = np.inf
        for t in range(sectors):
            total = 0.0
            for b in range(bands):
                for s in range(sectors):
                    d = abs(known[m, b, (s + t) % sectors] - view[b, s])
                    total += d if d < clip else clip
                if total >= best:
                    break
            if total < best:
                best = total
                turn[m] = t
        unlike[m] = best / (bands * sectors)
