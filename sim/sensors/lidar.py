"""A 3D LiDAR on a moving vehicle: per-point poses, noise, thin branches, drop-outs, own body.

A thin branch fills only a part of the beam, `coverage` = width / (divergence * range); it
returns with probability min(1, coverage)^2, else the beam goes on to what stands behind.
Walkers cover what is behind them where they are at the time of each beam.
A beam that met nothing within `range_max_m` is a miss; a beam that was lost (drop-out, own
body, too near, fault) is neither a point nor a miss. Not modelled: mixed pixels, intensity,
multiple reflections, rain.
"""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec
import numpy as np
from numba import njit
from numpy.typing import NDArray

from companion.core.messages import Array, Array32, LidarScan, freeze
from companion.core.rig import Mount
from sim.sensors.caster import Caster
from sim.sensors.patterns import rosette_pattern, spin_pattern
from sim.sensors.walker_rays import WalkerRays
from sim.world.mesh import Mesh
from sim.world.walkers import NOBODY, Walkers

NotNegative = Annotated[float, msgspec.Meta(ge=0)]
Fraction = Annotated[float, msgspec.Meta(ge=0, le=1)]
_STREAM = 1  # of the random numbers


class LidarConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Defaults: Livox Mid-360 class, figures of its data sheet where it gives them."""

    pattern: Literal["mid360", "spin64"] = "mid360"
    rate_hz: Annotated[float, msgspec.Meta(ge=1, le=50)] = 10.0
    points: Annotated[int, msgspec.Meta(ge=100, le=200_000)] = 20_000  # per sweep, mid360
    mid360_elevation_deg: tuple[float, float] = (-7.0, 52.0)
    beams: Annotated[int, msgspec.Meta(ge=1, le=128)] = 64  # spin64
    columns: Annotated[int, msgspec.Meta(ge=16, le=2048)] = 1024  # spin64
    spin64_elevation_deg: tuple[float, float] = (-22.5, 22.5)
    range_min_m: NotNegative = 0.2
    range_max_m: Annotated[float, msgspec.Meta(gt=1, le=200)] = 40.0
    range_sigma_m: NotNegative = 0.02  # near
    range_sigma_per_m: NotNegative = 0.0005  # grows with range, added in quadrature
    angle_sigma_deg: NotNegative = 0.05  # of the reported direction, per axis
    divergence_mrad: NotNegative = 3.0  # full angle
    dropout: Fraction = 0.01  # share of returns lost
    body_radius_m: NotNegative = 0.2  # own hull: a disc at the height of the body's origin
    miss_stride: Annotated[int, msgspec.Meta(ge=1)] = 4  # every n-th miss is reported

    @property
    def sweep_s(self) -> float:
        """Duration of one sweep."""
        return 1.0 / self.rate_hz

    @property
    def rays(self) -> int:
        """Beams per sweep."""
        return self.points if self.pattern == "mid360" else self.beams * self.columns


def knot_stamps(
    config: LidarConfig, stamp_ns: int, knots: int = 101, *, part: int = 0, parts: int = 1
) -> NDArray[np.int64]:
    """Times (knots,) at which (a piece of) a sweep that ends at `stamp_ns` needs body poses; evenly spaced."""
    sweep_ns = round(config.sweep_s * 1e9)
    begin_ns = stamp_ns - sweep_ns + part * sweep_ns // parts
    return begin_ns + np.arange(knots, dtype=np.int64) * (sweep_ns // parts) // (knots - 1)


class Lidar:
    """Renders sweeps; every sweep depends on its poses, the seed and its counter alone."""

    def __init__(
        self, config: LidarConfig, mount: Mount, caster: Caster, mesh: Mesh, seed: int, *, walkers: Walkers = NOBODY
    ) -> None:
        self.config = config
        self._p_body, self._R_body_sensor = mount.p_body, mount.R_body_sensor
        self._caster, self._seed = caster, seed
        self._widths_m = np.append(mesh.widths_m, np.float32(np.inf))  # the last is that of the walkers
        self._walkers = WalkerRays(walkers, mark=len(mesh.widths_m))
        nothing = np.empty((0, 3), np.float32)
        self._rosette: tuple[int, tuple[Array32, Array32]] = (-1, (nothing, nothing[:, 0]))
        if config.pattern == "spin64":
            self._spin = spin_pattern(config.beams, config.columns, config.spin64_elevation_deg)

    def scan(
        self,
        p_world: Array,
        q_world_body: Array,
        *,
        stamp_ns: int,
        counter: int,
        part: int = 0,
        parts: int = 1,
        lost_fraction: float = 0.0,
        dust_fraction: float = 0.0,
    ) -> LidarScan:
        """One sweep that ends at `stamp_ns`, or the `part`-th of `parts` equal pieces of its time.

        Body poses (K, 3) and (K, 4), K >= 2, at the `knot_stamps` of the piece. The fractions
        are faults: beams lost, and beams that dust 0.5 to 3 m away returns.
        """
        c = self.config
        dirs, phases = self._pattern(counter)
        inside = slice(*(int(np.searchsorted(phases, k / parts)) for k in (part, part + 1)))
        dirs, phases = dirs[inside], phases[inside]
        rng = np.random.default_rng([self._seed, _STREAM, counter, part])
        uniform = rng.random((len(dirs), 3), dtype=np.float32)
        normal = rng.standard_normal((len(dirs), 3), dtype=np.float32)
        rays = np.empty((len(dirs), 6), np.float32)
        seen = np.empty(len(dirs), np.bool_)
        mount = (self._p_body, self._R_body_sensor, c.body_radius_m)
        knots = np.array(p_world, np.float64), np.array(q_world_body, np.float64)
        _aim(dirs, phases * np.float32(parts) - np.float32(part), *knots, mount, rays, seen)
        ranges, triangles = self._cast(rays, dirs)
        walkers_m = self._walkers.distances(rays, stamp_ns * 1e-9 + c.sweep_s * (phases.astype(np.float64) - 1.0))
        self._walkers.cover(ranges, triangles, walkers_m)
        self._through_thin(rays, ranges, triangles, uniform, walkers_m)
        loss = 1.0 - (1.0 - c.dropout) * (1.0 - lost_fraction)
        _disturb(ranges, seen, uniform, (loss, dust_fraction, c.range_min_m, c.range_max_m))
        noise = (c.range_sigma_m, c.range_sigma_per_m, np.radians(c.angle_sigma_deg), c.range_max_m)
        points, ages, misses, miss_ages = _pack(dirs, phases, ranges, seen, normal, noise, (c.sweep_s, c.miss_stride))
        return freeze(  # type: ignore[no-any-return]
            LidarScan(
                stamp_ns=stamp_ns,
                points_sensor=points,
                point_age_s=ages,
                miss_dirs_sensor=misses,
                miss_age_s=miss_ages,
            )
        )

    def _pattern(self, counter: int) -> tuple[Array32, Array32]:
        c = self.config
        if c.pattern == "spin64":
            return self._spin
        if self._rosette[0] != counter:  # the pieces of a sweep share its pattern
            self._rosette = (counter, rosette_pattern(c.points, c.sweep_s, counter, c.mid360_elevation_deg))
        return self._rosette[1]

    def _cast(self, rays: Array32, dirs: Array32) -> tuple[Array32, NDArray[np.uint32]]:
        """First hits; cast by azimuth, as neighbours share their way through the scene (25 % faster)."""
        order = np.argsort((np.arctan2(dirs[:, 1], dirs[:, 0]) * 1e4).astype(np.int16), kind="stable")
        far, ids = self._caster.cast(rays[order])
        ranges, triangles = np.empty_like(far), np.empty_like(ids)
        ranges[order], triangles[order] = far, ids
        return ranges, triangles

    def _through_thin(
        self, rays: Array32, ranges: Array32, triangles: NDArray[np.uint32], uniform: Array32, far: Array32 | None
    ) -> None:
        """Let beams that a thin thing did not return go on to what stands behind it, in place."""
        divergence = 1e-3 * self.config.divergence_mrad
        passing, onward, gone = _weak(rays, ranges, triangles, self._widths_m, uniform, divergence)
        behind, again = self._caster.cast(onward)
        self._walkers.cover(behind, again, None if far is None else far[passing] - gone)
        _behind(passing, gone, behind, again, self._widths_m, uniform, divergence, ranges)


@njit(cache=True, nogil=True)
def _aim(dirs, phases, p_world, q_world, mount, rays, seen):  # type: ignore[no-untyped-def]
    """Rays in the world, each from the pose at its own time; seen: not blocked by the own hull."""
    p_body, R, body_radius = mount
    last = p_world.shape[0] - 1
    for n in range(dirs.shape[0]):
        k = min(int(phases[n] * last), last - 1)
        f = phases[n] * last - k
        d0, d1, d2 = dirs[n, 0], dirs[n, 1], dirs[n, 2]
        b0 = R[0, 0] * d0 + R[0, 1] * d1 + R[0, 2] * d2
        b1 = R[1, 0] * d0 + R[1, 1] * d1 + R[1, 2] * d2
        b2 = R[2, 0] * d0 + R[2, 1] * d1 + R[2, 2] * d2
        seen[n] = True
        if b2 * p_body[2] < 0.0:
            x, y = p_body[0] - p_body[2] * b0 / b2, p_body[1] - p_body[2] * b1 / b2
            seen[n] = x * x + y * y > body_radius * body_radius
        q = _blend(q_world[k], q_world[k + 1], f)
        origin = _turned(q, p_body[0], p_body[1], p_body[2])
        beam = _turned(q, b0, b1, b2)
        for c in range(3):
            rays[n, c] = (1.0 - f) * p_world[k, c] + f * p_world[k + 1, c] + origin[c]
            rays[n, 3 + c] = beam[c]


@njit(cache=True, nogil=True)
def _blend(a, b, f):  # type: ignore[no-untyped-def]
    """Normalised linear interpolation of two near quaternions."""
    g = f if a[0] * b[0] + a[1] * b[1] + a[2] * b[2] + a[3] * b[3] >= 0.0 else -f
    w, x = (1.0 - f) * a[0] + g * b[0], (1.0 - f) * a[1] + g * b[1]
    y, z = (1.0 - f) * a[2] + g * b[2], (1.0 - f) * a[3] + g * b[3]
    s = 1.0 / np.sqrt(w * w + x * x + y * y + z * z)
    return s * w, s * x, s * y, s * z


@njit(cache=True, nogil=True)
def _turned(q, v0, v1, v2):  # type: ignore[no-untyped-def]
    """A vector turned by a unit quaternion: v + 2 w (u x v) + 2 u x (u x v)."""
    w, x, y, z = q
    c0, c1, c2 = 2.0 * (y * v2 - z * v1), 2.0 * (z * v0 - x * v2), 2.0 * (x * v1 - y * v0)
    return (
        v0 + w * c0 + y * c2 - z * c1,
        v1 + w * c1 + z * c0 - x * c2,
        v2 + w * c2 + x * c1 - y * c0,
    )


@njit(cache=True, nogil=True)
def _weak(rays, ranges, triangles, widths, uniform, divergence):  # type: ignore[no-untyped-def]
    """Beams that what they hit does not return: index, the rest of the beam, the way gone."""
    passing = np.empty(ranges.shape[0], np.int64)
    count = 0
    for n in range(ranges.shape[0]):
        if ranges[n] < np.inf:
            coverage = widths[triangles[n]] / max(divergence * ranges[n], 1e-9)
            if coverage < 1.0 and uniform[n, 0] >= coverage * coverage:
                passing[count] = n
                count += 1
    passing = passing[:count]
    onward = np.empty((count, 6), np.float32)
    gone = np.empty(count, np.float32)
    for k in range(count):
        n = passing[k]
        gone[k] = ranges[n] + widths[triangles[n]] + np.float32(0.01)  # past the far wall, too
        for c in range(3):
            onward[k, c] = rays[n, c] + gone[k] * rays[n, 3 + c]
            onward[k, 3 + c] = rays[n, 3 + c]
    return passing, onward, gone


@njit(cache=True, nogil=True)
def _behind(passing, gone, behind, triangles, widths, uniform, divergence, ranges):  # type: ignore[no-untyped-def]
    """Ranges of the beams that went on; a second weak target is lost (NaN)."""
    for k in range(passing.shape[0]):
        n = passing[k]
        ranges[n] = gone[k] + behind[k]
        if behind[k] < np.inf:
            coverage = widths[triangles[k]] / max(divergence * ranges[n], 1e-9)
            if coverage < 1.0 and uniform[n, 0] >= coverage * coverage:
                ranges[n] = np.nan


@njit(cache=True, nogil=True)
def _disturb(ranges, seen, uniform, limits):  # type: ignore[no-untyped-def]
    """Dust returns and losses, in place; seen turns False where the sensor says nothing at all."""
    loss, dust, range_min, range_max = limits
    for n in range(ranges.shape[0]):
        if uniform[n, 1] < dust:
            ranges[n] = min(ranges[n], 0.5 + 2.5 * uniform[n, 0])
        hit = ranges[n] <= range_max
        if ranges[n] < range_min or np.isnan(ranges[n]) or (hit and uniform[n, 2] < loss):
            seen[n] = False


@njit(cache=True, nogil=True)
def _pack(dirs, phases, ranges, seen, normal, noise, sweep):  # type: ignore[no-untyped-def]
    """Points with noise, and every n-th miss."""
    sigma, sigma_per_m, sigma_angle, range_max = noise
    sweep_s, stride = sweep
    hits, free = 0, 0
    for n in range(ranges.shape[0]):
        if seen[n]:
            if ranges[n] <= range_max:
                hits += 1
            else:
                free += 1
    points, ages = np.empty((hits, 3), np.float32), np.empty(hits, np.float32)
    kept = (free + stride - 1) // stride
    misses, miss_ages = np.empty((kept, 3), np.float32), np.empty(kept, np.float32)
    i, j = 0, 0
    for n in range(ranges.shape[0]):
        if not seen[n]:
            continue
        x, y, z = dirs[n, 0], dirs[n, 1], dirs[n, 2]
        age = sweep_s * (1.0 - phases[n])
        if ranges[n] <= range_max:
            level = max(np.sqrt(x * x + y * y), 1e-6)
            e, a = sigma_angle * normal[n, 1], sigma_angle * normal[n, 2] / level
            r = ranges[n] + normal[n, 0] * np.sqrt(sigma**2 + (sigma_per_m * ranges[n]) ** 2)
            points[i, 0] = r * (x - a * y - e * x * z / level)
            points[i, 1] = r * (y + a * x - e * y * z / level)
            points[i, 2] = r * (z + e * level)
            ages[i] = age
            i += 1
        else:
            if j % stride == 0:
                m = j // stride
                misses[m, 0], misses[m, 1], misses[m, 2] = x, y, z
                miss_ages[m] = age
            j += 1
    return points, ages, misses, miss_ages
