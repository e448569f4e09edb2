"""Ramps with rounded ends: fast speeds below a cap, whose acceleration along the way changes no faster than allowed.

Over arc length s, E = v^2 / 2 has the acceleration as its slope, and v E'' is its rate of change. With v bounded by
the cap, |E''| <= j / v_cap is a band on second differences that does not depend on E. The two regularisations of
J.-M. Lasry and P.-L. Lions ("A remark on regularization in Hilbert spaces", Israel J. Math. 1986) lead into it: what
bends up too much is cut off by parabolas from below (an envelope of lines, once their curvature is taken off), what
bends down too much by the convex hull. Both are exact on the samples, take one sweep, and a plan that starts on an
old one under the same caps, with its speed and acceleration, is never slower than the old one.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from companion.core.messages import Array

_SLOWEST_M_S = 0.05  # curvature over arc length has no bound at a standstill
_STANDING = 0.5 * 0.2**2  # v^2 / 2 below which braking may end at once


def jerk_limited(
    squared: Array, step_m: float, *, along: tuple[float, float], start: tuple[float, float]
) -> tuple[Array, bool]:
    """(squared speeds (N,) within the limits, whether the start could be met).

    `squared` (N,) are caps, m2/s2, at points `step_m` apart; `along` = (acceleration m/s2, jerk m/s3); `start` = (speed
    m/s, acceleration m/s2 from the first point to the second; at a standstill the jerk alone bounds that). If the start
    cannot be met the first value is below its square. An infinite jerk bounds the acceleration alone.
    """
    accel, jerk = along
    ramps = _ramps(0.5 * squared, accel * step_m)
    begin, slope = 0.5 * start[0] ** 2, min(max(start[1], -accel), accel)
    if begin <= 0.0:
        slope = min(max(slope, 0.5 * (0.5 * jerk * (3.0 * step_m) ** 2) ** (2.0 / 3.0) / step_m), accel)
    reach = np.minimum(ramps, begin + accel * step_m * np.arange(len(ramps)))
    if jerk == math.inf:
        return 2.0 * reach, bool(ramps[0] >= begin)
    bends = jerk * step_m**2 / np.sqrt(2.0 * np.maximum(reach, 0.5 * _SLOWEST_M_S**2))
    energy = np.empty_like(ramps)
    met = _between(ramps, bends, (accel * step_m, begin, slope * step_m), energy)
    return 2.0 * energy, bool(met)


@njit(cache=True, nogil=True)
def _ramps(cap, most):  # type: ignore[no-untyped-def]
    """The cap with slopes of at most `most` per sample, up and down."""
    low = cap.copy()
    for k in range(1, len(low)):
        low[k] = min(low[k], low[k - 1] + most)
    for k in range(len(low) - 2, -1, -1):
        low[k] = min(low[k], low[k + 1] + most)
    return low


@njit(cache=True, nogil=True)
def _between(ramps, bends, limits, energy):  # type: ignore[no-untyped-def]
    """Fills `energy`; limits = (most slope per sample; value and slope at the first)."""
    most, begin, slope = limits
    count = len(ramps)
    bowl = np.zeros(count)  # second differences are `bends`
    rise = 0.0
    for k in range(1, count):
        bowl[k] = bowl[k - 1] + rise
        rise += bends[k]
    _cut_below(ramps, bowl, bends, energy)
    low = _ramps(energy, most)
    met = low[0] >= begin - 1e-9
    _rise_from(begin, slope, bends, most, low)
    _hull_below(low + bowl, energy)
    for k in range(count):
        energy[k] = max(
            min(energy[k] - bowl[k], low[k]), 0.0
        )  # where the cap is 0, exactly 0: it is where the way ends
    return met


@njit(cache=True, nogil=True)
def _rise_from(begin, slope, bends, most, low):  # type: ignore[no-untyped-def]
    """Lowers `low` to what can be reached from a first value and slope."""
    reach, rise, least = begin, slope, min(begin, _STANDING)
    low[0] = min(low[0], begin)
    for k in range(1, len(low)):
        reach += rise
        if reach < least:
            reach, rise = least, max(rise, 0.0)
        low[k] = min(low[k], reach)
        rise = min(rise + bends[k], most)


@njit(cache=True, nogil=True)
def _cut_below(cap, bowl, bends, out):  # type: ignore[no-untyped-def]
    """out_k = min over m of cap_m + (bowl above its tangent at m)_k: what remains bends up by `bends` at most.

    Minus the bowl these are lines of rising slope to be taken off, so their envelope is built with a stack.
    """
    count = len(cap)
    slopes, heights, lines = np.empty(count), np.empty(count), np.empty(count, np.int64)
    rise = -bends[0]
    top = 0
    for m in range(count):
        slope = -(rise + 0.5 * bends[m])  # tangent at the sample, between the slopes to both sides
        height = cap[m] - bowl[m] - slope * m
        rise += bends[m]
        slopes[m], heights[m] = slope, height
        while top > 1:
            a, b = lines[top - 2], lines[top - 1]
            if (heights[m] - heights[a]) * (slopes[a] - slopes[b]) <= (heights[b] - heights[a]) * (slopes[a] - slope):
                top -= 1
            else:
                break
        lines[top] = m
        top += 1
    at = 0
    for k in range(count):
        while at + 1 < top and slopes[lines[at + 1]] * k + heights[lines[at + 1]] <= (
            slopes[lines[at]] * k + heights[lines[at]]
        ):
            at += 1
        out[k] = min(cap[k], slopes[lines[at]] * k + heights[lines[at]] + bowl[k])


@njit(cache=True, nogil=True)
def _hull_below(values, out):  # type: ignore[no-untyped-def]
    """Lower convex hull of samples, at all of them (A. Andrew's monotone chain)."""
    count = len(values)
    chain = np.empty(count, np.int64)
    top = 0
    for k in range(count):
        while top > 1:
            a, b = chain[top - 2], chain[top - 1]
            if (values[b] - values[a]) * (k - a) >= (values[k] - values[a]) * (b - a):
                top -= 1
            else:
                break
        chain[top] = k
        top += 1
    for n in range(top - 1):
        a, b = chain[n], chain[n + 1]
        for k in range(a, b + 1):
            out[k] = values[a] + (values[b] - values[a]) * (k - a) / (b - a)
    out[chain[top - 1]] = values[chain[top - 1]]
