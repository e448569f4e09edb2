"""Where a LiDAR looks and when: directions in the sensor frame and times within a sweep."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from companion.core.messages import Array32

_EMITTERS = 4  # of the rosette, a quarter turn apart
_TURNS_HZ = 10.0  # about one turn per sweep of 0.1 s, as in the real one
_STROKES_HZ = 700.0 + 10.0 * 0.6180339887  # up and down; the golden part keeps sweeps from repeating


def spin_pattern(beams: int, columns: int, elevation_deg: tuple[float, float]) -> tuple[Array32, Array32]:
    """Directions (N, 3) and phases in [0, 1) (N,) of a LiDAR that spins clockwise, by columns."""
    column, beam = np.divmod(np.arange(beams * columns), beams)
    low, high = np.radians(elevation_deg)
    elevation = low + (high - low) * beam / max(beams - 1, 1)
    azimuth = -2 * math.pi * column / columns
    level = np.cos(elevation)
    dirs = np.stack([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)], axis=1)
    return dirs.astype(np.float32), (column / columns).astype(np.float32)


def rosette_pattern(
    points: int, sweep_s: float, counter: int, elevation_deg: tuple[float, float]
) -> tuple[Array32, Array32]:
    """Directions (N, 3) and phases (N,) of sweep `counter` of a non-repetitive LiDAR (Mid-360 class).

    Four emitters, a quarter turn apart, turn about z while they swing between the two
    elevations; swings and turns have an irrational ratio. Even in elevation, as the
    sensor's data sheet shows it; the true optics are not public.
    """
    dirs = np.empty((points, 3), np.float32)
    phases = np.empty(points, np.float32)
    low, high = np.radians(elevation_deg)
    _rosette(counter * points, sweep_s / points, (low, high), dirs, phases)
    return dirs, phases


@njit(cache=True, nogil=True)
def _rosette(first, step_s, span, dirs, phases):  # type: ignore[no-untyped-def]
    count = dirs.shape[0]
    for k in range(count):
        emitter = k % _EMITTERS
        t = (first + k) * step_s
        swing = t * _STROKES_HZ + emitter / _EMITTERS
        swing -= math.floor(swing)
        elevation = span[0] + (span[1] - span[0]) * abs(2.0 * swing - 1.0)
        turn = t * _TURNS_HZ + emitter / _EMITTERS
        azimuth = 2.0 * math.pi * (turn - math.floor(turn))
        dirs[k, 0] = math.cos(elevation) * math.cos(azimuth)
        dirs[k, 1] = math.cos(elevation) * math.sin(azimuth)
        dirs[k, 2] = math.sin(elevation)
        phases[k] = k / count
