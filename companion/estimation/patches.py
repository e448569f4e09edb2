"""Patches of the ground that were seen once and are looked for in every later image.

A patch has its picture at each level of the pyramid, its centre in odom, and the map's plane there as the two tangents
along which one pixel of its picture lies. A later view of it is the affine part of the homography that the plane
induces, which over 9 pixels is the homography to within 0.02 px.

Brightness may change by a gain and an offset of each patch: slopes are kept with their part along the picture and the
constant taken out, so that both drop out of the alignment (S. Baker and I. Matthews, "Lucas-Kanade 20 years on",
part 3, 2003: projecting out). Sources: J. Engel et al., "Direct sparse odometry", PAMI 2018 (patches of pixels,
affine brightness); C. Forster et al., "SVO", T-RO 2017 (patches of earlier images, slopes of the patch's own image).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import cv2
import numpy as np
from numba import njit

from companion.core.messages import Array, Array32, Bytes2D
from companion.estimation.registration import Flags

_RIDGE = 1e-3  # of the slopes' Gram matrix, so that an edge has an inverse, too


@dataclass(slots=True)
class Patches:
    """N patches of n = (2 half + 1)^2 pixels at L levels; frames: odom, pixels of the full image."""

    centres: Array  # (N, 3), m
    tangents: Array  # (N, 3, 2), m per pixel to the right and down in the image of birth
    rays: Array  # (N, 3), from the camera of birth, 1 along its axis
    pictures: Array  # (N, L, n), grey levels, mean taken out
    energy: Array  # (N, L), sum of squares of the picture
    slopes: Array  # (N, L, n, 2), grey levels per pixel of the level, gain and offset projected out
    inverse: Array  # (N, L, 2, 2), of the slopes' Gram matrix
    misses: Array  # (N,), images in a row in which it was not found

    def __len__(self) -> int:
        return len(self.centres)

    @property
    def arrays(self) -> tuple[Array, ...]:
        """All but `misses`, for kernels."""
        return self.centres, self.tangents, self.rays, self.pictures, self.energy, self.slopes, self.inverse

    def only(self, which: Flags) -> Patches:
        """Those of a mask (N,)."""
        return Patches(*(np.ascontiguousarray(getattr(self, f.name)[which]) for f in fields(self)))

    def joined(self, others: Patches) -> Patches:
        """These and then the others."""
        pairs = ((getattr(self, f.name), getattr(others, f.name)) for f in fields(self))
        return Patches(*(np.concatenate(pair) for pair in pairs))


def no_patches(levels: int, half_px: int) -> Patches:
    """Zero of them."""
    n = (2 * half_px + 1) ** 2
    shapes = ((3,), (3, 2), (3,), (levels, n), (levels,), (levels, n, 2), (levels, 2, 2), ())
    return Patches(*(np.empty((0, *shape)) for shape in shapes))


def pyramid(pixels: Bytes2D, levels: int, smooth_px: float) -> list[Array32]:
    """Smoothed images, each half as large as the one before; a pixel is the mean of the four below it."""
    images = [cv2.GaussianBlur(pixels.astype(np.float32), (0, 0), smooth_px)]
    for _ in range(levels - 1):
        height, width = images[-1].shape
        images.append(cv2.resize(images[-1], (width // 2, height // 2), interpolation=cv2.INTER_AREA))
    return [np.asarray(image, np.float32) for image in images]


def cut(
    images: Sequence[Array32],
    corners: Array32,
    anchors: tuple[Array, Array],
    view: tuple[Array, Array, Array],
    half_px: int,
) -> Patches:
    """New patches around OpenCV pixels (N, 2).

    `anchors`: their points in odom (N, 3) and the map's planes there (N, 4); `view`: the camera's position in odom
    (3,), rays in odom (N, 3), 1 along its axis, and how a ray changes per pixel to the right and down (3, 2).
    """
    (centres, planes), (origin, rays, per_px) = anchors, view
    shape = (len(corners), len(images), (2 * half_px + 1) ** 2)
    pictures, slopes = np.zeros(shape), np.zeros((*shape, 2))
    energy, inverse = np.zeros(shape[:2]), np.zeros((*shape[:2], 2, 2))
    for level, image in enumerate(images):
        at = (corners.astype(np.float64) + 0.5) * 0.5**level - 0.5
        _cut(image, at, half_px, level, pictures, energy, slopes, inverse)
    tangents = _tangents(centres - origin, planes[:, :3], rays, per_px)
    return Patches(centres, tangents, rays, pictures, energy, slopes, inverse, np.zeros(len(corners)))


def _tangents(sight: Array, normals: Array, rays: Array, per_px: Array) -> Array:
    """d point / d pixel (N, 3, 2) where a ray meets its plane: s (dray - ray (n.dray) / (n.ray)), s the depth."""
    depth = (sight * rays).sum(axis=1) / (rays**2).sum(axis=1)
    along = (normals @ per_px) / (normals * rays).sum(axis=1)[:, None]
    return np.asarray(depth[:, None, None] * (per_px - rays[:, :, None] * along[:, None, :]))


@njit(cache=True, nogil=True)
def grey_at(image, x, y):  # type: ignore[no-untyped-def]
    """Bilinear; the centre of the first pixel is 0, and (x, y) lies inside."""
    j, i = int(x), int(y)
    a, b = x - j, y - i
    upper = image[i, j] + a * (image[i, j + 1] - image[i, j])
    lower = image[i + 1, j] + a * (image[i + 1, j + 1] - image[i + 1, j])
    return upper + b * (lower - upper)


@njit(cache=True, nogil=True)
def _cut(image, at, half, level, pictures, energy, slopes, inverse):  # type: ignore[no-untyped-def]
    """Pictures and projected slopes of a level; energy stays 0 where the image ends too soon or is even."""
    height, width = image.shape
    side = 2 * half + 1
    n = side * side
    for q in range(at.shape[0]):
        x, y = at[q, 0], at[q, 1]
        if not (x > half + 2 and y > half + 2 and x < width - half - 3 and y < height - half - 3):
            continue
        K, G = pictures[q, level], slopes[q, level]
        for j in range(n):
            u, v = x + j % side - half, y + j // side - half
            K[j] = grey_at(image, u, v)
            G[j, 0] = 0.5 * (grey_at(image, u + 1, v) - grey_at(image, u - 1, v))
            G[j, 1] = 0.5 * (grey_at(image, u, v + 1) - grey_at(image, u, v - 1))
        energy[q, level] = _project_out(K, G)
        if energy[q, level] > 0.0:
            _invert_gram(G, inverse[q, level])


@njit(cache=True, nogil=True)
def _project_out(K, G):  # type: ignore[no-untyped-def]
    """Takes the mean out of a picture, mean and picture out of its slopes; returns the picture's energy."""
    n = K.shape[0]
    K -= K.mean()
    energy = (K * K).sum()
    if energy < n:
        return 0.0
    for a in range(2):
        G[:, a] -= G[:, a].mean()
        G[:, a] -= K * ((K * G[:, a]).sum() / energy)
    return energy


@njit(cache=True, nogil=True)
def _invert_gram(G, inverse):  # type: ignore[no-untyped-def]
    a, b, c = (G[:, 0] * G[:, 0]).sum(), (G[:, 0] * G[:, 1]).sum(), (G[:, 1] * G[:, 1]).sum()
    ridge = _RIDGE * (a + c) + 1e-6
    a, c = a + ridge, c + ridge
    det = a * c - b * b
    inverse[0, 0], inverse[0, 1], inverse[1, 0], inverse[1, 1] = c / det, -b / det, -b / det, a / det
