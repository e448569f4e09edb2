"""From image points to points of the world: each ray to the first surface of the local map.

The ground is taken as the surface through the ground cells' centres, which is smoother than the
cells; what stands on it is met where the ray enters its first occupied cell.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import msgspec
import numpy as np
from numpy.typing import NDArray

from companion.core.messages import Array, Array32, LocalMap
from companion.core.rig import Rig
from companion.mapping.voxel_map import OCCUPIED_CELL

Flags = NDArray[np.bool_]
_Positive = Annotated[float, msgspec.Meta(gt=0.0)]
_REFINEMENTS, _SETTLED_M = 3, 0.01
_UP = np.array([0.0, 0.0, 1.0])


class BackProjectionConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Reach, and what the error of a point is made of."""

    max_range_m: _Positive = 8.0  # along the ray
    pixel_sigma_px: _Positive = 1.0  # of an image point, each axis
    ground_sigma_m: _Positive = 0.06  # height of the ground surface; a cell of 0.2 m alone has 0.058
    step_cells: Annotated[float, msgspec.Meta(gt=0.0, le=1.0)] = 0.75  # of the march along a ray


@dataclass(frozen=True, slots=True, eq=False)
class Pose:
    """A pose of the body with its variances."""

    p_odom: Array  # (3,)
    R_odom_body: Array  # (3, 3)
    variance: Array  # diagonal, theta_body then p_odom, (6,), as in Odometry


@dataclass(frozen=True, slots=True, eq=False)
class Surface:
    """Where rays met the world."""

    position_odom: Array  # m, (K, 3)
    covariance: Array  # m2, (K, 3, 3)
    met: Flags  # (K,), the ray met something within reach; else its row above means nothing
    ground: Flags  # (K,), and that is the ground


def back_project(uv_px: Array, pose: Pose, rig: Rig, local_map: LocalMap, config: BackProjectionConfig) -> Surface:
    """The surface points that the camera of `rig` sees at image points `uv_px` (K, 2).

    Covariance to first order: pixel noise, attitude and position move the point on the
    surface's plane, the surface's height moves it along the ray. With the ray r, the plane's
    normal n and Q = I - r n' / (n' r):
    Q (S_p + A S_theta A' + depth^2 S_pixel) Q' + sigma^2 r r' / (n' r)^2.
    """
    rays, origin = _rays(uv_px, pose, rig)
    depth, met, ground = _march(rays, origin, local_map, config)
    position = origin + rays * depth[:, None]
    normal = np.where(ground[:, None], _UP, rays / np.linalg.norm(rays, axis=1, keepdims=True))
    sigma_m = np.where(ground, config.ground_sigma_m, local_map.resolution_m / np.sqrt(12.0))
    pixel = _pixel_covariance(depth, pose, rig, config)
    covariance = _covariance((rays, normal, position), pixel, sigma_m, pose)
    return Surface(position, covariance, met, ground)


def ground_height(local_map: LocalMap, xy_odom: Array) -> Array:
    """Height (N,) of the ground at (N, 2), m: bilinear between seen ground cells, NaN where half of them lack."""
    field = local_map.ground_z_odom
    place = (xy_odom - local_map.origin_odom[:2]) / local_map.resolution_m - 0.5
    low = np.floor(np.nan_to_num(place)).astype(np.int64)
    part = place - low
    total, weight = np.zeros(len(place)), np.zeros(len(place))
    for corner in np.array([[0, 0], [0, 1], [1, 0], [1, 1]]):
        z = _at(field, low + corner)
        share = np.abs(1 - corner - part).prod(axis=1)
        share = np.where(np.isnan(z), 0.0, share)
        total += share * np.nan_to_num(z)
        weight += share
    return np.where(weight > 0.5, total / np.maximum(weight, 1e-9), np.nan)


def _rays(uv_px: Array, pose: Pose, rig: Rig) -> tuple[Array, Array]:
    """Rays (K, 3) in odom, of depth 1 along the optical axis, and where they begin (3,)."""
    f, (cx, cy) = rig.pinhole.focal_px, rig.pinhole.center_px
    optical = np.column_stack([(uv_px[:, 0] - cx) / f, (uv_px[:, 1] - cy) / f, np.ones(len(uv_px))])
    origin = pose.p_odom + pose.R_odom_body @ rig.camera.p_body
    return optical @ (pose.R_odom_body @ rig.camera.R_body_sensor).T, origin


def _march(rays: Array, origin: Array, local_map: LocalMap, config: BackProjectionConfig) -> tuple[Array, Flags, Flags]:
    """Depth (K,) of the first surface, whether there is one, and whether it is the ground.

    A ray is in the ground when it is below its surface. Cells next to that surface are the
    ground's own; only higher ones stop a ray before it.
    """
    cell_m = local_map.resolution_m
    step_m = config.step_cells * cell_m
    far_m = np.arange(1, int(config.max_range_m / step_m) + 1) * step_m
    depth = far_m / np.linalg.norm(rays, axis=1, keepdims=True)  # (K, T)
    cells = np.floor((origin - local_map.origin_odom + rays[:, None] * depth[..., None]) / cell_m).astype(np.int64)
    z = origin[2] + rays[:, 2:] * depth
    above = z - _at(local_map.ground_z_odom, cells[..., :2])  # NaN: no ground seen there
    occupied = _at(local_map.state, cells) == OCCUPIED_CELL
    hit_ground, at_ground = _first(above <= 0.0)
    hit_thing, at_thing = _first(occupied & ~(above < 1.5 * cell_m))
    row = np.arange(len(rays))
    fine, settled = _on_ground(rays, origin, local_map, depth[row, at_ground])
    is_ground = hit_ground & settled & ~(hit_thing & (at_thing < at_ground))
    is_thing = hit_thing & ~(hit_ground & (at_ground <= at_thing))
    return np.where(is_ground, fine, depth[row, at_thing]), is_ground | is_thing, is_ground


def _on_ground(rays: Array, origin: Array, local_map: LocalMap, depth: Array) -> tuple[Array, Flags]:
    """Depth (K,) where the rays meet the smooth ground, from a guess, and whether that settled."""
    steep = np.minimum(rays[:, 2], -1e-3)
    first, change = depth, np.full(len(depth), np.nan)
    for _ in range(_REFINEMENTS):
        points = origin + rays * depth[:, None]
        change = (points[:, 2] - ground_height(local_map, points[:, :2])) / -steep
        depth = depth + change
    near = np.abs(depth - first) < 3.0 * local_map.resolution_m
    return depth, near & (np.abs(change) < _SETTLED_M)


def _first(flags: Flags) -> tuple[Flags, NDArray[np.int64]]:
    """Whether a row (K, T) holds a True, and where the first is."""
    return np.asarray(flags.any(axis=1)), np.asarray(flags.argmax(axis=1))


def _at(field: Array32 | NDArray[np.uint8], cells: NDArray[np.int64]) -> NDArray[np.float64]:
    """Values (...) of a field at cells (..., 2 or 3); NaN outside."""
    inside, flat = np.ones(cells.shape[:-1], np.bool_), np.zeros(cells.shape[:-1], np.int64)
    for axis, size in enumerate(field.shape):
        index = cells[..., axis]
        inside &= (index >= 0) & (index < size)
        flat = flat * size + index
    return np.where(inside, field.reshape(-1)[np.where(inside, flat, 0)], np.nan)


def _pixel_covariance(depth: Array, pose: Pose, rig: Rig, config: BackProjectionConfig) -> Array:
    """(K, 3, 3): an image point's noise at its depth, across the optical axis, in odom."""
    across = (pose.R_odom_body @ rig.camera.R_body_sensor)[:, :2]
    spread = (depth * config.pixel_sigma_px / rig.pinhole.focal_px) ** 2
    return np.asarray(spread[:, None, None] * (across @ across.T))


def _covariance(geometry: tuple[Array, Array, Array], pixel: Array, sigma_m: Array, pose: Pose) -> Array:
    ray, normal, position = geometry
    steep = (normal * ray).sum(axis=1)[:, None, None]
    Q = np.eye(3) - ray[:, :, None] * normal[:, None, :] / steep
    arm = (position - pose.p_odom) @ pose.R_odom_body  # in the body's axes
    A = -pose.R_odom_body @ _skew(arm)
    moved = np.diag(pose.variance[3:]) + (A * pose.variance[:3]) @ A.transpose(0, 2, 1) + pixel
    along = ray[:, :, None] * ray[:, None, :] * (sigma_m[:, None, None] / steep) ** 2
    covariance = Q @ moved @ Q.transpose(0, 2, 1) + along
    return np.asarray(0.5 * (covariance + covariance.transpose(0, 2, 1)))


def _skew(v: Array) -> Array:
    """(K, 3) -> (K, 3, 3)."""
    x, y, z = v.T
    zero = np.zeros(len(v))
    return np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=1).reshape(-1, 3, 3)
