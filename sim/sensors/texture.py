"""The ground's picture: a real photograph, mirrored to tile without seams, with its mip levels."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from companion.core.messages import Bytes2D

_PHOTO = Path(__file__).resolve().parents[1] / "world" / "ground_texture.jpg"  # see TEXTURE_NOTICE.md
TILE_PX = 2048  # period of the mirrored picture; a power of two
LEVELS = 7


def load_tile() -> Bytes2D:
    """The periodic grey tile (2048, 2048): column is world x, row is world y."""
    photo = cv2.imread(str(_PHOTO), cv2.IMREAD_GRAYSCALE)
    if photo is None:
        raise FileNotFoundError(_PHOTO)
    half = np.asarray(photo, np.uint8)
    top = np.hstack([half, half[:, ::-1]])
    return np.ascontiguousarray(np.vstack([top, top[::-1]]))


def mip_levels(tile: Bytes2D) -> tuple[NDArray[np.uint8], NDArray[np.int64]]:
    """All levels in one flat array, and where each starts; every level halves the one before."""
    levels = [tile]
    while len(levels) < LEVELS:
        a = levels[-1].astype(np.uint16)
        mean = (a[::2, ::2] + a[1::2, ::2] + a[::2, 1::2] + a[1::2, 1::2] + 2) // 4
        levels.append(mean.astype(np.uint8))
    starts = np.cumsum([0] + [level.size for level in levels[:-1]])
    return np.concatenate([level.ravel() for level in levels]), starts


@njit(cache=True, nogil=True)
def _sample(flat, starts, x_px, y_px, footprint_px):  # type: ignore[no-untyped-def]
    """Lookup at tile coordinates (texel k covers [k, k + 1)), for pixels of `footprint_px`.

    Bilinear in two levels, and between them linear in the footprint: a logarithm per pixel would cost as much again.
    """
    level, texels = 0, footprint_px
    while texels >= 2.0 and level < LEVELS - 1:
        level, texels = level + 1, 0.5 * texels
    low = _bilinear(flat, starts, x_px, y_px, level)
    if texels < 1.001 or level == LEVELS - 1:
        return low
    return low + (texels - 1.0) * (_bilinear(flat, starts, x_px, y_px, level + 1) - low)


@njit(cache=True, nogil=True)
def _bilinear(flat, starts, x_px, y_px, level):  # type: ignore[no-untyped-def]
    size = TILE_PX >> level
    scale = 1.0 / (1 << level)
    x, y = x_px * scale - 0.5, y_px * scale - 0.5
    i, j = int(np.floor(x)), int(np.floor(y))
    fx, fy = x - i, y - j
    i0, i1, start = i & (size - 1), (i + 1) & (size - 1), starts[level]
    row0, row1 = start + (j & (size - 1)) * size, start + ((j + 1) & (size - 1)) * size
    upper = flat[row0 + i0] * (1.0 - fx) + flat[row0 + i1] * fx
    lower = flat[row1 + i0] * (1.0 - fx) + flat[row1 + i1] * fx
    return upper * (1.0 - fy) + lower * fy
