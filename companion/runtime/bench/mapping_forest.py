"""Seeded synthetic forests, seen by two kinds of LiDAR on a flying vehicle.

forest = make_forest(DENSE, seed=1)
scans = list(fly(forest, "mid360", numbers=range(4)))
"""

from __future__ import annotations

import ctypes
import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any, Literal

import libusb_package
import numpy as np
from numpy.typing import NDArray

from companion.core.messages import Array, Array32
from companion.runtime.bench.mapping_scans import Scan

Lidar = Literal["os64", "mid360"]
OPEN, DENSE = 1 / 36, 1 / 16  # trees per m2
LENGTH_M, HALF_WIDTH_M = 70.0, 45.0
FLIGHT_SCANS = 200  # along LENGTH_M
_NEAREST_M, _FARTHEST_M, _NOISE_M = 0.3, 80.0, 0.02
_MARGIN_M = 40.0  # of forest before and behind the way
_SIDES = 12  # of a trunk
_LEAVES, _HERBS = 260, 25  # quads per crown, per plant
_MID360_BEAMS = 20_000
_HEIGHT_M = {"os64": 2.5, "mid360": 2.0}  # of flight above ground


@dataclass(frozen=True, slots=True, eq=False)
class Scenery:
    """Triangles; `first` tells where each kind begins among them."""

    vertices: Array32  # (V, 3), m
    triangles: NDArray[np.uint32]  # (T, 3)
    phase: Array  # of the terrain's waves
    first: dict[str, int]


def make_forest(trees_per_m2: float, *, seed: int) -> Scenery:
    """Rolling ground, leaning trunks with crowns of loose leaves, and low plants."""
    rng = np.random.default_rng(seed)
    phase = rng.uniform(0, 2 * math.pi, 6)
    area_m2 = (LENGTH_M + 2 * _MARGIN_M) * 2 * HALF_WIDTH_M
    feet = _spread(rng, int(trees_per_m2 * area_m2))
    feet = feet[np.min(np.linalg.norm(feet[:, None] - way(np.linspace(-2, 72, 400))[None], axis=2), axis=1) > 1.1]
    heights = rng.uniform(10, 18, len(feet))
    bottom = ground_z(feet, phase) - 0.3
    parts = {
        "ground": _ground(rng, phase),
        "trunks": _trunks(rng, feet, bottom, heights),
        "leaves": _crowns(rng, feet, bottom, heights),
        "herbs": _herbs(rng, phase, int(0.08 * area_m2)),
    }
    return join(parts, phase)


def fly(scenery: Scenery, lidar: Lidar, *, numbers: Iterable[int]) -> Iterator[Scan]:
    """Scans `numbers` of a flight of FLIGHT_SCANS; each depends on its number alone."""
    scene = raycasting(scenery)
    for number in numbers:
        R, p = _pose(number, _HEIGHT_M[lidar], scenery.phase)
        yield look(scene, beams_of(lidar, number), (R, p), np.random.default_rng([number, 77]))


def look(scene: Any, beams: Array, pose: tuple[Array, Array], rng: np.random.Generator) -> Scan:
    """One scan along unit `beams` (B, 3) in body, with noise along the beam."""
    R, p = pose
    rays = np.concatenate([np.broadcast_to(p, beams.shape), beams @ R.T], axis=1).astype(np.float32)
    hits = scene.cast_rays(_open3d().core.Tensor.from_numpy(rays), nthreads=1)
    reach = hits["t_hit"].numpy().astype(np.float64)
    seen = (reach > _NEAREST_M) & (reach < _FARTHEST_M)
    reach_m = reach[seen] + rng.normal(0, _NOISE_M, int(seen.sum()))
    points = np.ascontiguousarray(beams[seen] * reach_m[:, None], np.float32)
    return Scan(points, R, p, hits["primitive_ids"].numpy()[seen])


def way(x_m: Array) -> Array:
    """Position (N, 2) of the flight at forward way x (N,), m."""
    return np.stack([x_m, 4.0 * np.sin(2 * math.pi * x_m / 45.0)], axis=1)


def ground_z(xy: Array, phase: Array) -> Array:
    """Height (N,) of the terrain, m: waves of 57, 12 and 3 m length."""
    x, y = xy.T
    waves = ((0.8, 0.11, 0.09), (0.25, 0.53, 0.47), (0.08, 2.1, 1.9))
    heights = [
        size * np.sin(kx * x + phase[2 * n]) * np.cos(ky * y + phase[2 * n + 1])
        for n, (size, kx, ky) in enumerate(waves)
    ]
    return np.asarray(np.sum(heights, axis=0))


def join(parts: dict[str, tuple[Array, Array]], phase: Array) -> Scenery:
    """One mesh of named parts (vertices, triangles)."""
    vertices, triangles, first = [], [], {}
    corners = faces = 0
    for name, (v, t) in parts.items():
        vertices.append(v.astype(np.float32))
        triangles.append(t + corners)
        first[name] = faces
        corners, faces = corners + len(v), faces + len(t)
    return Scenery(np.concatenate(vertices), np.concatenate(triangles).astype(np.uint32), phase, first)


def tubes(starts: Array, ends: Array, radii_m: tuple[Array, Array]) -> tuple[Array, Array]:
    """Prisms (vertices, triangles) around the lines from `starts` to `ends` (N, 3), with radii (N,) there."""
    along = ends - starts
    side = np.cross(
        along, np.where(np.abs(along[:, 2:]) < 0.9 * np.linalg.norm(along, axis=1)[:, None], [0, 0, 1.0], [1.0, 0, 0])
    )
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    other = np.cross(along / np.linalg.norm(along, axis=1, keepdims=True), side)
    angle = 2 * math.pi * np.arange(_SIDES) / _SIDES
    ring = np.cos(angle)[:, None] * side[:, None] + np.sin(angle)[:, None] * other[:, None]
    rings = [at[:, None] + ring * radius[:, None, None] for at, radius in zip((starts, ends), radii_m, strict=True)]
    k, after = np.arange(_SIDES), (np.arange(_SIDES) + 1) % _SIDES
    faces = np.concatenate([np.stack([k, after, k + _SIDES], 1), np.stack([after, after + _SIDES, k + _SIDES], 1)])
    number = 2 * _SIDES * np.arange(len(starts))
    return np.stack(rings, axis=1).reshape(-1, 3), (number[:, None, None] + faces).reshape(-1, 3)


def sheet(axes: tuple[Array, Array], heights: Array) -> tuple[Array, Array]:
    """A surface (vertices, triangles) over the grid of two axes, with heights (X, Y)."""
    x, y = np.meshgrid(*axes, indexing="ij")
    ny = len(axes[1])
    corner = (np.arange(len(axes[0]) - 1)[:, None] * ny + np.arange(ny - 1)).ravel()
    faces = [(corner, corner + ny, corner + 1), (corner + 1, corner + ny, corner + ny + 1)]
    return np.stack([x, y, heights], axis=-1).reshape(-1, 3), np.concatenate([np.stack(f, axis=1) for f in faces])


def _ground(rng: np.random.Generator, phase: Array) -> tuple[Array, Array]:
    axes = (np.arange(-45.0, LENGTH_M + 45, 0.4), np.arange(-HALF_WIDTH_M - 10, HALF_WIDTH_M + 10, 0.4))
    xy = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    z = ground_z(xy.reshape(-1, 2), phase).reshape(xy.shape[:2])
    return sheet(axes, z + rng.normal(0, 0.03, z.shape))


def _trunks(rng: np.random.Generator, feet: Array, bottom: Array, heights: Array) -> tuple[Array, Array]:
    radius, lean = rng.uniform(0.1, 0.4, len(feet)), rng.normal(0, 0.03, (len(feet), 2))
    low = np.column_stack([feet, bottom])
    middle, top = (low + np.column_stack([lean, np.ones(len(feet))]) * (heights * part)[:, None] for part in (0.5, 1.0))
    lower = tubes(low, middle, (1.15 * radius, 0.9 * radius))
    upper = tubes(middle, top, (0.9 * radius, 0.35 * radius))
    return np.concatenate([lower[0], upper[0]]), np.concatenate([lower[1], upper[1] + len(lower[0])])


def _crowns(rng: np.random.Generator, feet: Array, bottom: Array, heights: Array) -> tuple[Array, Array]:
    count = len(feet)
    radius = rng.uniform(1.2, 2.4, count)
    axes = np.column_stack([radius, radius, 0.26 * heights])
    inside = _directions(rng, count * _LEAVES) * rng.random((count * _LEAVES, 1)) ** (1 / 3)
    middle = np.column_stack([feet, bottom + 0.72 * heights])
    leaves = np.repeat(middle, _LEAVES, axis=0) + inside * np.repeat(axes, _LEAVES, axis=0)
    return _quads(rng, leaves, rng.uniform(0.05, 0.16, len(leaves)))


def _herbs(rng: np.random.Generator, phase: Array, count: int) -> tuple[Array, Array]:
    at = _spread(rng, count)
    middle = np.repeat(np.column_stack([at, ground_z(at, phase) + 0.35]), _HERBS, axis=0)
    return _quads(rng, middle + rng.normal(0, 0.25, middle.shape), rng.uniform(0.03, 0.1, len(middle)))


def _quads(rng: np.random.Generator, centers: Array, half_m: Array) -> tuple[Array, Array]:
    """A square of edge 2 * `half_m` (N,) around each centre (N, 3), turned at random."""
    u = _directions(rng, len(centers))
    v = np.cross(u, _directions(rng, len(centers)))
    v *= (half_m / np.linalg.norm(v, axis=1))[:, None]
    u *= half_m[:, None]
    corners = np.stack([centers - u - v, centers + u - v, centers + u + v, centers - u + v], axis=1)
    first = 4 * np.arange(len(centers))[:, None, None]
    return corners.reshape(-1, 3), (first + np.array([[0, 1, 2], [0, 2, 3]])).reshape(-1, 3)


def _spread(rng: np.random.Generator, count: int) -> Array:
    low, high = (-_MARGIN_M, -HALF_WIDTH_M), (LENGTH_M + _MARGIN_M, HALF_WIDTH_M)
    return rng.uniform(low, high, (count, 2))


def _directions(rng: np.random.Generator, count: int) -> Array:
    v = rng.normal(size=(count, 3))
    return np.asarray(v / np.linalg.norm(v, axis=1, keepdims=True))


def _pose(number: int, height_m: float, phase: Array) -> tuple[Array, Array]:
    """(R_odom_body, p_odom): along the way, nose down, swaying."""
    x = LENGTH_M * number / (FLIGHT_SCANS - 1)
    here, ahead = way(np.array([x, x + 0.05]))
    z = ground_z(here[None], phase)[0] + height_m + 0.4 * math.sin(0.05 * number)
    yaw = math.atan2(ahead[1] - here[1], ahead[0] - here[0])
    R = rotation(yaw, 0.08 + 0.03 * math.sin(0.21 * number), 0.05 * math.sin(0.17 * number))
    return R, np.array([here[0], here[1], z])


def rotation(yaw: float, pitch: float, roll: float) -> Array:
    """R_odom_body (3, 3) of turns about z, y, x, rad."""
    (cz, sz), (cy, sy), (cx, sx) = ((math.cos(a), math.sin(a)) for a in (yaw, pitch, roll))
    about_z = np.array([[cz, -sz, 0], [sz, cz, 0], [0, 0, 1]])
    about_y = np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])
    about_x = np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]])
    return np.asarray(about_z @ about_y @ about_x)


def _os64_beams() -> Array:
    """64 x 1024, elevation +- 22.5 deg, column by column."""
    azimuth, elevation = np.meshgrid(
        2 * math.pi * np.arange(1024) / 1024, np.radians(np.linspace(-22.5, 22.5, 64)), indexing="ij"
    )
    return _unit(azimuth.ravel(), elevation.ravel())


def _mid360_beams(number: int) -> Array:
    """A pattern that does not repeat, elevation -7 .. 52 deg."""
    i = np.arange(number * _MID360_BEAMS, (number + 1) * _MID360_BEAMS, dtype=np.float64)
    azimuth = 2 * math.pi * ((i * 0.00731 + 0.31 * np.sin(i * 1e-4)) % 1.0)
    return _unit(azimuth, np.radians(-7 + 59 * np.abs((i * 0.17318) % 2.0 - 1.0)))


def beams_of(lidar: Lidar, number: int) -> Array:
    """Unit directions (B, 3) of a scan, in body."""
    return _os64_beams() if lidar == "os64" else _mid360_beams(number)


def _unit(azimuth: Array, elevation: Array) -> Array:
    flat = np.cos(elevation)
    return np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)], axis=1)


def raycasting(scenery: Scenery) -> Any:
    """Open3D's scene of the mesh, for `look`; one thread."""
    o3d = _open3d()
    scene = o3d.t.geometry.RaycastingScene(nthreads=1)
    scene.add_triangles(o3d.core.Tensor(scenery.vertices), o3d.core.Tensor(scenery.triangles))
    return scene


def _open3d() -> Any:
    """Import Open3D; its wheel needs libusb, which libusb-package brings along."""
    ctypes.CDLL(str(libusb_package.get_library_path()), ctypes.RTLD_GLOBAL)
    import open3d

    return open3d
