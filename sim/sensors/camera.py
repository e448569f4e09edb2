"""A downward global-shutter camera: grey pinhole images of textured ground, trunks and leaves.

A first cast through every second pixel corner finds depth; where the four corners of a
2 x 2 block lie on one surface its depth is interpolated (1/depth is linear on a plane), else
each pixel casts its own ray, so that thin things have true edges. Walkers cover the pixels whose
own rays meet them. Not modelled: lens distortion, rolling shutter, shadows, motion blur.
"""

from __future__ import annotations

from typing import Annotated, Any

import msgspec
import numpy as np
from numba import njit
from numpy.typing import NDArray

from companion.core.geometry import rotation_from_quaternion
from companion.core.messages import Array, Array32, CameraImage, freeze
from companion.core.rig import Mount, Pinhole
from sim.sensors.caster import Caster
from sim.sensors.texture import _sample, load_tile, mip_levels
from sim.sensors.walker_rays import WalkerRays
from sim.world.mesh import GROUND, TRUNK, WALL, Mesh
from sim.world.walkers import NOBODY, Walkers

NotNegative = Annotated[float, msgspec.Meta(ge=0)]
_STREAM = 2  # of the random numbers
_STEP = 2  # px between the corners of the first cast
_LIGHT = (0.35, 0.25, 0.9)  # direction to the sky's bright side; need not be unit
_CENTER_PX = 512.0  # of the photograph, over the world's origin
_SKY, _BARK = 235.0, 0.55  # grey of the sky; bark against the ground's picture
_COAT = np.float32(1.3)  # brightness of walkers


class CameraConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A small machine-vision camera."""

    rate_hz: Annotated[float, msgspec.Meta(ge=1, le=120)] = 15.0
    texture_m_per_px: Annotated[float, msgspec.Meta(ge=0.001, le=1)] = 0.01  # of the ground's picture
    noise_sigma: NotNegative = 2.0  # grey levels
    vignetting: Annotated[float, msgspec.Meta(ge=0, le=1)] = 0.2  # loss of light in the corners
    gain: NotNegative = 1.0  # exposure


class Camera:
    """Renders frames; every frame depends on its pose, the seed and its counter alone."""

    def __init__(
        self,
        config: CameraConfig,
        mount: Mount,
        pinhole: Pinhole,
        *,
        caster: Caster,
        mesh: Mesh,
        seed: int,
        walkers: Walkers = NOBODY,
    ) -> None:
        self.config, self.pinhole = config, pinhole
        self._p_body, self._R_body_cam = mount.p_body, mount.R_body_sensor
        self._caster, self._seed = caster, seed
        self._classes = np.append(mesh.classes, np.uint8(TRUNK))  # the last is that of the walkers
        self._shade = np.append(_shade_of(mesh), _COAT)
        self._walkers = WalkerRays(walkers, mark=len(mesh.classes))
        self._flat, self._starts = mip_levels(load_tile())
        self._vignette = _vignette(pinhole, config.vignetting)
        width, height = pinhole.width_px, pinhole.height_px
        self._corner_dirs = _directions(pinhole, np.arange(0, width + 1, _STEP), np.arange(0, height + 1, _STEP))
        self._pixel_dirs = _directions(pinhole, np.arange(width) + 0.5, np.arange(height) + 0.5)

    def frame(
        self, p_world: Array, q_world_body: Array, *, stamp_ns: int, counter: int, gain: float = 1.0
    ) -> CameraImage:
        """The frame at `stamp_ns` from a body pose (3,), (4,); `gain` is a fault: 0 is dark."""
        c = self.config
        R_world_body = rotation_from_quaternion(q_world_body)
        R, p = R_world_body @ self._R_body_cam, p_world + R_world_body @ self._p_body
        depth, triangle = self._surfaces(R, p)
        self._walkers.cover_picture((self._pixel_dirs, R, p), stamp_ns * 1e-9, depth, triangle)
        shape = self._pixel_dirs.shape[:2]
        noise = np.random.default_rng([self._seed, _STREAM, counter]).standard_normal(shape, dtype=np.float32)
        noise *= np.float32(c.noise_sigma)
        pixels = np.empty(shape, np.uint8)
        scale = (1.0 / c.texture_m_per_px, 1.0 / (self.pinhole.focal_px * c.texture_m_per_px))
        _draw(
            (self._pixel_dirs, R, p, depth, triangle),
            (self._classes, self._shade, self._flat, self._starts),
            scale,
            (noise, self._vignette, np.float32(c.gain * gain)),
            pixels,
        )
        return freeze(CameraImage(stamp_ns=stamp_ns, pixels=pixels))  # type: ignore[no-any-return]

    def _surfaces(self, R_world_cam: Array, p_world: Array) -> tuple[Array32, NDArray[np.uint32]]:
        """Depth along the optical axis (H, W), inf: sky, and the triangle of each pixel."""
        corners, rows, columns = self._corner_dirs, *self._corner_dirs.shape[:2]
        far, ids = self._caster.cast(_rays(corners.reshape(-1, 3), R_world_cam, p_world))
        depth, triangle, unsure = _interpolate(far.reshape(rows, columns), ids.reshape(rows, columns), self._classes)
        dirs = self._pixel_dirs.reshape(-1, 3)[unsure]
        far, ids = self._caster.cast(_rays(dirs, R_world_cam, p_world))
        depth.reshape(-1)[unsure], triangle.reshape(-1)[unsure] = far, ids
        return depth, triangle


def _directions(pinhole: Pinhole, u_px: NDArray[Any], v_px: NDArray[Any]) -> Array32:
    """Rays (len(v), len(u), 3) through image points, z = 1, in the optical frame."""
    cx, cy = pinhole.center_px
    dirs = np.ones((len(v_px), len(u_px), 3), np.float32)
    dirs[..., 0] = (u_px - cx) / pinhole.focal_px
    dirs[..., 1] = ((v_px - cy) / pinhole.focal_px)[:, None]
    return dirs


def _vignette(pinhole: Pinhole, loss: float) -> Array32:
    dirs = _directions(pinhole, np.arange(pinhole.width_px) + 0.5, np.arange(pinhole.height_px) + 0.5)
    square = dirs[..., 0] ** 2 + dirs[..., 1] ** 2
    return np.asarray(1.0 - loss * square / square.max(), np.float32)


def _shade_of(mesh: Mesh) -> Array32:
    """Brightness per triangle (T,): trunks, branches and walls by the light, leaves at random, ground 1."""
    corners = mesh.vertices[mesh.triangles]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    light = np.asarray(_LIGHT, np.float32)
    length = np.maximum(np.linalg.norm(normal, axis=1) * np.linalg.norm(light), 1e-12)
    shade = 0.55 + 0.45 * np.abs(normal @ light) / length
    leaf = (mesh.classes > TRUNK) & (mesh.classes != WALL)
    shade[leaf] *= np.random.default_rng(0).uniform(0.5, 1.5, int(leaf.sum())).astype(np.float32)
    shade[mesh.classes == GROUND] = 1.0
    return np.asarray(shade, np.float32)


def _rays(dirs: Array32, R_world_cam: Array, p_world: Array) -> Array32:
    rays = np.empty((len(dirs), 6), np.float32)
    _turn(dirs, R_world_cam, p_world, rays)
    return rays


@njit(cache=True, nogil=True)
def _turn(dirs, R, p, rays):  # type: ignore[no-untyped-def]
    for n in range(dirs.shape[0]):
        for c in range(3):
            rays[n, c] = p[c]
            rays[n, 3 + c] = R[c, 0] * dirs[n, 0] + R[c, 1] * dirs[n, 1] + R[c, 2] * dirs[n, 2]


@njit(cache=True, nogil=True)
def _interpolate(far, ids, classes):  # type: ignore[no-untyped-def]
    """Depths of all pixels from the corners of their blocks; pixels on edges are returned as unsure."""
    rows, columns = far.shape[0] - 1, far.shape[1] - 1
    depth = np.empty((rows * _STEP, columns * _STEP), np.float32)
    triangle = np.empty((rows * _STEP, columns * _STEP), np.uint32)
    unsure = np.empty(depth.size, np.int64)
    count = 0
    for i in range(rows):
        for j in range(columns):
            smooth = _smooth(far, ids, classes, i, j)
            a, b = 1.0 / far[i, j], 1.0 / far[i, j + 1]
            c, d = 1.0 / far[i + 1, j], 1.0 / far[i + 1, j + 1]
            for y in range(_STEP):
                for x in range(_STEP):
                    u, v = (x + 0.5) / _STEP, (y + 0.5) / _STEP
                    row, column = i * _STEP + y, j * _STEP + x
                    inverse = (a * (1 - u) + b * u) * (1 - v) + (c * (1 - u) + d * u) * v
                    depth[row, column] = 1.0 / inverse if inverse > 0.0 else np.inf
                    triangle[row, column] = ids[i, j]
                    if not smooth:
                        unsure[count] = row * columns * _STEP + column
                        count += 1
    return depth, triangle, unsure[:count]


@njit(cache=True, nogil=True)
def _smooth(far, ids, classes, i, j):  # type: ignore[no-untyped-def]
    """Whether the four corners of a block see one surface."""
    first = ids[i, j]
    low, high, same = far[i, j], far[i, j], True
    for k in range(1, 4):
        other = ids[i + k // 2, j + k % 2]
        depth = far[i + k // 2, j + k % 2]
        low, high = min(low, depth), max(high, depth)
        same = same and other == first
        if other != first and (low == np.inf or high == np.inf or classes[other] != classes[first]):
            return False
    if same:
        return True
    solid = classes[first] <= TRUNK or classes[first] == WALL
    return solid and high < (1.2 if classes[first] == GROUND else 1.03) * low


@njit(cache=True, nogil=True)
def _draw(view, surface, scale, light, pixels):  # type: ignore[no-untyped-def]
    """Grey levels: the ground's picture by world x and y, bark by height and angle, noise, vignette."""
    dirs, R, p, depth, triangle = view
    classes, shade, flat, starts = surface
    per_m, per_depth = scale
    noise, vignette, gain = light
    for i in range(pixels.shape[0]):
        for j in range(pixels.shape[1]):
            t = depth[i, j]
            grey = _SKY
            if t < np.inf:
                d0, d1 = t * dirs[i, j, 0], t * dirs[i, j, 1]
                x = p[0] + R[0, 0] * d0 + R[0, 1] * d1 + R[0, 2] * t
                y = p[1] + R[1, 0] * d0 + R[1, 1] * d1 + R[1, 2] * t
                if classes[triangle[i, j]] == GROUND:
                    grey = _sample(flat, starts, x * per_m + _CENTER_PX, y * per_m + _CENTER_PX, t * per_depth)
                else:
                    z = p[2] + R[2, 0] * d0 + R[2, 1] * d1 + R[2, 2] * t
                    bark = _sample(flat, starts, 2.0 * (x - y) * per_m, 0.7 * z * per_m, t * per_depth)
                    grey = shade[triangle[i, j]] * (20.0 + _BARK * bark)
            value = grey * gain * vignette[i, j] + noise[i, j]
            pixels[i, j] = np.uint8(min(max(value + 0.5, 0.0), 255.0))
