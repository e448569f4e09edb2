"""Figures of one tracked flight, against the truth.

Crosswise figures are taken between the first and the last 0.3 m of the path, so that neither hovering before it
nor holding after it counts.
"""

from __future__ import annotations

import msgspec
import numpy as np
from numpy.typing import NDArray

from companion.core.messages import Array
from companion.planning.polyline import arc_length
from companion.runtime.bench.tracking_flight import Flown

_END_M = 0.3
_FORTH_M = 4.0


class Score(msgspec.Struct, frozen=True, kw_only=True):
    """All against the truth, but for what the names say."""

    rmse_m: float  # across the path
    worst_m: float
    rmse_estimate_m: float  # across the path of where the vehicle believed to be: the tracker's own share
    top_m_s: float
    mean_m_s: float
    lag_m_s: float  # planned speed minus the vehicle's at the same place, mean
    late_s: float  # flown minus planned time
    over_m_s: float  # the most that the vehicle was faster than the path's top speed
    past_end_m: float  # overshoot beyond the end, along the path
    jerk_m_s3: float  # of the true motion, rms, up to 2.5 Hz
    setpoint_rate_m_s2: float  # of the velocity setpoint, rms
    wobble_per_m: float  # changes of side per metre of path: an oscillation has many
    clearance_m: float
    seconds: float
    ended: bool
    contact: str


def score(flown: Flown) -> Score:
    """The figures of a flight."""
    points = flown.course.points
    s, off, side = along_and_across(points, flown.p_true)
    along = arc_length(points)
    believed = along_and_across(points, flown.p_map)[1]
    speed = np.linalg.norm(flown.v_true, axis=1)
    under_way = (s > _END_M) & (s < along[-1] - _END_M)
    planned = np.interp(s, along, flown.course.speeds)
    end = (points[-1] - points[-2]) / np.linalg.norm(points[-1] - points[-2])
    crossings = np.count_nonzero(np.diff(np.sign(side[under_way])))
    changes = np.diff(flown.setpoint_v, axis=0) / np.diff(flown.setpoint_s)[:, None]
    return Score(
        rmse_m=_round(np.sqrt(np.mean(off[under_way] ** 2))),
        worst_m=_round(off[under_way].max()),
        rmse_estimate_m=_round(np.sqrt(np.mean(believed[under_way] ** 2))),
        top_m_s=_round(speed.max()),
        mean_m_s=_round(speed[under_way].mean()),
        lag_m_s=_round((planned - speed)[under_way].mean()),
        late_s=_round(flown.time_s[under_way][-1] - flown.time_s[under_way][0] - _planned_s(flown)),
        over_m_s=_round(speed.max() - flown.course.speeds.max()),
        past_end_m=_round(max(0.0, *((flown.p_true - points[-1]) @ end)[s > along[-1] - _END_M])),
        jerk_m_s3=_round(_jerk(flown, under_way)),
        setpoint_rate_m_s2=_round(np.sqrt(np.mean(np.sum(changes**2, axis=1)))),
        wobble_per_m=_round(crossings / along[-1]),
        clearance_m=_round(flown.clearance_m),
        seconds=_round(flown.time_s[under_way][-1] - flown.time_s[under_way][0]),
        ended=flown.ended,
        contact=flown.contact,
    )


def along_and_across(points: Array, p: Array) -> tuple[Array, Array, Array]:
    """Arc length (M,) of the places of the path nearest to `p` (M, 3), distance (M,), side in the plane (M,).

    Left of the path is positive. Looked for near the last one, so that a path may come near itself.
    """
    along = arc_length(points)
    s, off, side = np.zeros(len(p)), np.zeros(len(p)), np.zeros(len(p))
    last = 0.0
    for n, place in enumerate(p):
        near: NDArray[np.int64] = np.flatnonzero((along[1:] >= last - 1.0) & (along[:-1] <= last + _FORTH_M))
        start, way = points[near], points[near + 1] - points[near]
        squared = np.maximum(np.sum(way * way, axis=1), 1e-18)
        part = np.clip(np.sum((place - start) * way, axis=1) / squared, 0.0, 1.0)
        gap = place - start - part[:, None] * way
        k = int(np.argmin(np.sum(gap * gap, axis=1)))
        last = s[n] = along[near[k]] + part[k] * np.sqrt(squared[k])
        off[n] = np.linalg.norm(gap[k])
        side[n] = way[k, 0] * gap[k, 1] - way[k, 1] * gap[k, 0]
    return s, off, side


def _planned_s(flown: Flown) -> float:
    """Time between the places between which figures are taken, as planned."""
    along = arc_length(flown.course.points)
    s = np.linspace(_END_M, along[-1] - _END_M, 2000)
    speeds = np.interp(s, along, flown.course.speeds)
    return float(np.sum(np.diff(s) / np.maximum(0.5 * (speeds[1:] + speeds[:-1]), 1e-3)))


def _jerk(flown: Flown, rows: NDArray[np.bool_]) -> float:
    """RMS over second differences of the velocity at 5 Hz."""
    stride = max(round(0.2 / float(np.median(np.diff(flown.time_s)))), 1)
    v, dt = flown.v_true[rows][::stride], 0.2
    return float(np.sqrt(np.mean(np.sum((np.diff(v, n=2, axis=0) / dt**2) ** 2, axis=1)))) if len(v) > 2 else 0.0


def _round(value: float) -> float:
    return round(float(value), 4)
