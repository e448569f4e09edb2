"""What a replay came to where the LiDAR was out: error at its return, what was said of it, and how it went on.

gaps_of(run)[0].error_m
"""

from __future__ import annotations

from itertools import pairwise

import msgspec
import numpy as np

from companion.core.messages import Array, Odometry
from companion.runtime.bench.estimation_replay import Run
from companion.runtime.bench.estimation_score import Truth

_LEAST_S = 0.7  # a shorter pause between sweeps is none
_LATER_S = 3.0


class Gap(msgspec.Struct, frozen=True, kw_only=True):
    """Errors are changes of the position's error since the last sweep before."""

    at_s: float
    length_s: float
    error_m: float  # before the first sweep of after
    sigma_m: float  # published then, of the worst axis
    covered: bool  # within three published sigmas on each axis
    later_m: float  # three seconds after
    step_m: float  # largest change between two odometries, beyond their velocity, from the return to then


def gaps_of(run: Run, true: Truth) -> tuple[Gap, ...]:
    """Every gap of the sweeps that were used; `true` is the truth at the stamps of `run.odometry`, in its odom."""
    sweeps = [s.stamp_ns for s in run.states if s.source == "lidar"]
    stamps = np.array([o.stamp_ns for o in run.odometry])
    off = np.array([o.p_odom for o in run.odometry]) - true.p
    steps = _steps(run.odometry)
    ends = [(a, b) for a, b in pairwise(sweeps) if b - a > _LEAST_S * 1e9 and b + _LATER_S * 1e9 < stamps[-1]]
    return tuple(_gap(a, b, stamps, off, steps, run.odometry) for a, b in ends)


def returns_of(stamps_ns: Array, off: Array) -> tuple[tuple[float, float], ...]:
    """Per gap, m: change of the errors `off` (N, 3) from the last state before to the first after, and 3 s later."""
    ends = np.flatnonzero(np.diff(stamps_ns) > _LEAST_S * 1e9) + 1
    later = np.searchsorted(stamps_ns, stamps_ns[ends] + round(_LATER_S * 1e9))
    pairs = [(a, b) for a, b in zip(ends, later, strict=True) if b < len(stamps_ns)]
    return tuple(
        (float(np.linalg.norm(off[a] - off[a - 1])), float(np.linalg.norm(off[b] - off[a - 1]))) for a, b in pairs
    )


def _gap(begin_ns: int, end_ns: int, stamps: Array, off: Array, steps: Array, odometry: list[Odometry]) -> Gap:
    before, back, later = np.searchsorted(stamps, [begin_ns, end_ns, end_ns + _LATER_S * 1e9])
    last = back - 1
    change = off[last] - off[before]
    sigma = np.sqrt(odometry[last].pose_variance[3:])
    return Gap(
        at_s=round(float(begin_ns - stamps[0]) * 1e-9, 2),
        length_s=round(float(end_ns - begin_ns) * 1e-9, 2),
        error_m=float(np.linalg.norm(change)),
        sigma_m=float(sigma.max()),
        covered=bool((np.abs(off[last]) <= 3.0 * sigma).all()),
        later_m=float(np.linalg.norm(off[later] - off[before])),
        step_m=float(steps[last : later + 1].max()),
    )


def _steps(odometry: list[Odometry]) -> Array:
    """(N,), m: how far each is from where the one before, and its velocity, would have it."""
    p, v = np.array([o.p_odom for o in odometry]), np.array([o.v_odom for o in odometry])
    dt = np.diff([o.stamp_ns for o in odometry])[:, None] * 1e-9
    return np.concatenate([[0.0], np.linalg.norm(p[1:] - p[:-1] - v[:-1] * dt, axis=1)])
