"""What moves in a world: upright cylinders that walk along polylines, to and fro.

Where a walker is depends on the time alone, so every sensor, the contact check and a test
agree on it, in whatever process they run and in whatever order they ask.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numba import njit
from numpy.typing import NDArray

from companion.core.errors import InputError
from companion.core.messages import Array
from sim.world.spec import EmptySpec

Tables = tuple[Array, NDArray[np.int64], Array]  # of the kernels: tracks, rows, traits
_SPACING_M = 0.25  # of the points of a track, about
_MARGIN_M = 0.25  # between walker and trunk, beside the lean
_SHORTEST_M = 8.0  # of a drawn track
_TRIES = 5_000  # of drawing a leg
_LENGTH, _SPEED, _PHASE, _RADIUS, _HEIGHT = range(5)  # places in `traits`


@dataclass(frozen=True, eq=False)
class Walkers:
    """M upright cylinders; their feet are on the ground."""

    tracks: Array  # (P, 3), m, world: points of all tracks, evenly spaced along each
    rows: NDArray[np.int64]  # (M, 2): first point of the track, number of its segments
    traits: Array  # (M, 5): length of the track m, speed m/s, way gone at time 0 m, radius m, height m

    def __len__(self) -> int:
        return len(self.rows)

    @property
    def radius_m(self) -> Array:
        """(M,)."""
        return self.traits[:, _RADIUS]

    @property
    def height_m(self) -> Array:
        """(M,)."""
        return self.traits[:, _HEIGHT]

    def feet(self, stamp_ns: int) -> Array:
        """Where they stand at that time, (M, 3), m, world."""
        out = np.empty((len(self), 3))
        _all_feet(*self.tables(), stamp_ns * 1e-9, out)
        return out

    def first_hit(self, p_world: Array, direction: Array, stamp_ns: int) -> float:
        """Distance from p along a unit direction to the first walker at that time; inf: none."""
        ray = np.concatenate([p_world, direction]).astype(np.float64)
        return float(nearest_walker(self.tables(), ray, stamp_ns * 1e-9, math.inf))

    def tables(self) -> Tables:
        """Copies for the kernels: a read-only array would be one more type to compile for."""
        return self.tracks.copy(), self.rows.copy(), self.traits.copy()


NOBODY = Walkers(np.zeros((0, 3)), np.zeros((0, 2), np.int64), np.zeros((0, 5)))


def make_walkers(
    spec: EmptySpec,
    trunks: Array,
    bounds: tuple[Array, Array],
    ground_z: Callable[[Array], Array],
    rng: np.random.Generator,
) -> Walkers:
    """The walkers of the given ways, then those of drawn ways; speeds and places at time 0 are drawn.

    `trunks` (N, 3) are x, y and radius of the stems, `bounds` the stand's corners (2,), and
    `ground_z` maps points (n, 2) to heights (n,), m, world. A drawn way lies in the stand and
    keeps off trunks and start. Raises InputError when there is no room.
    """
    paths = [np.asarray(path, np.float64).reshape(-1, 2) for path in spec.walker_paths]
    low, high = np.maximum(bounds[0], -spec.walker_reach_m), np.minimum(bounds[1], spec.walker_reach_m)
    paths += [_draw(spec, trunks, (low, high), rng) for _ in range(spec.walkers)]
    if not paths:
        return NOBODY
    flat = [_resampled(path) for path in paths]
    counts = np.array([len(track) for track in flat], np.int64)
    length = np.array([_length(path) for path in paths])
    speed = rng.uniform(*spec.walker_speed_m_s, len(paths))
    phase = rng.uniform(0.0, 2.0 * length)
    size = np.broadcast_to([spec.walker_radius_m, spec.walker_height_m], (len(paths), 2))
    xy = np.concatenate(flat)
    return Walkers(
        tracks=np.column_stack([xy, ground_z(xy)]),
        rows=np.stack([np.cumsum(counts) - counts, counts - 1], axis=1),
        traits=np.column_stack([length, speed, phase, size]),
    )


def _resampled(path: Array) -> Array:
    """Evenly spaced points (n, 2), about `_SPACING_M` apart, along a polyline (K, 2)."""
    along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(path, axis=0).T))])
    at = np.linspace(0.0, along[-1], max(math.ceil(along[-1] / _SPACING_M), 1) + 1)
    return np.stack([np.interp(at, along, path[:, k]) for k in range(2)], axis=1)


def _length(path: Array) -> float:
    return float(np.hypot(*np.diff(path, axis=0).T).sum())


def _draw(spec: EmptySpec, trunks: Array, box: tuple[Array, Array], rng: np.random.Generator) -> Array:
    """A way of `walker_turns` corners between its ends, (K, 2)."""
    for _ in range(_TRIES):
        path = rng.uniform(*box, (spec.walker_turns + 2, 2))
        if _length(path) >= _SHORTEST_M and all(_clear(spec, trunks, a, b) for a, b in pairwise(path)):
            return np.asarray(path)
    raise InputError(
        f"no way of {spec.walker_turns + 1} straight legs between the stems",
        field="walkers",
        valid="fewer walker_turns, a larger walker_reach_m, or walker_paths",
    )


def _clear(spec: EmptySpec, trunks: Array, a: Array, b: Array) -> bool:
    """Whether a leg keeps off the trunks and the start."""
    x, y = np.append(trunks[:, 0], 0.0), np.append(trunks[:, 1], 0.0)
    room = np.append(trunks[:, 2] + _MARGIN_M, spec.walker_start_gap_m) + spec.walker_radius_m
    way = b - a
    t = np.clip(((x - a[0]) * way[0] + (y - a[1]) * way[1]) / max(float(way @ way), 1e-9), 0.0, 1.0)
    return bool(np.all(np.hypot(x - a[0] - t * way[0], y - a[1] - t * way[1]) > room))


@njit(cache=True, nogil=True)
def _all_feet(tracks, rows, traits, time_s, out):  # type: ignore[no-untyped-def]
    for k in range(rows.shape[0]):
        out[k, 0], out[k, 1], out[k, 2] = feet_of(tracks, rows, traits, k, time_s)


@njit(cache=True, nogil=True)
def feet_of(tracks, rows, traits, k, time_s):  # type: ignore[no-untyped-def]
    """Feet of walker k: a triangle wave along its track."""
    length, first, segments = traits[k, _LENGTH], rows[k, 0], rows[k, 1]
    s = (traits[k, _PHASE] + traits[k, _SPEED] * time_s) % (2.0 * length)
    u = min(s, 2.0 * length - s) / length * segments
    i = min(int(u), segments - 1)
    f, a, b = u - i, tracks[first + i], tracks[first + i + 1]
    return a[0] + f * (b[0] - a[0]), a[1] + f * (b[1] - a[1]), a[2] + f * (b[2] - a[2])


@njit(cache=True, nogil=True)
def nearest_walker(tables, ray, time_s, reach):  # type: ignore[no-untyped-def]
    """Distance along a ray (6,), in lengths of its direction, to the first walker nearer than `reach`."""
    tracks, rows, traits = tables
    best = reach
    for k in range(rows.shape[0]):
        x, y, z = feet_of(tracks, rows, traits, k, time_s)
        best = _cylinder(ray, (x, y, z), traits[k, _RADIUS], traits[k, _HEIGHT], best)
    return best


@njit(cache=True, nogil=True)
def _cylinder(ray, feet, radius, height, best):  # type: ignore[no-untyped-def]
    """Entry of a ray into side or top of an upright cylinder if nearer than `best`, else `best`."""
    px, py, pz = np.float64(ray[0]) - feet[0], np.float64(ray[1]) - feet[1], np.float64(ray[2]) - feet[2]
    dx, dy, dz = np.float64(ray[3]), np.float64(ray[4]), np.float64(ray[5])
    a, b, c = dx * dx + dy * dy, px * dx + py * dy, px * px + py * py - radius * radius
    if c > 0.0 and (b >= 0.0 or b * b < a * c):
        return best  # outside, and going away or passing by
    if pz > height and dz < 0.0:
        t = (height - pz) / dz
        x, y = px + t * dx, py + t * dy
        if x * x + y * y <= radius * radius:
            return min(best, t)
    if c <= 0.0:
        return best
    t = (-b - math.sqrt(b * b - a * c)) / a
    return t if t < best and 0.0 <= pz + t * dz <= height else best
