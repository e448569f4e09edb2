"""2D grids as the image and YAML that ROS' map_server and Nav2 read.

map_server takes a pixel v (255: white) for P = (255 - v) / 255, if `negate` is 0; P above
`occupied_thresh` is occupied, below `free_thresh` free. Source: documentation of nav2_map_server.
"""

from __future__ import annotations

from io import BytesIO
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from companion.core.errors import InputError
from companion.core.messages import Array32
from companion.mapping.formats.grid import Grid2D

Mode = Literal["trinary", "scale", "raw"]
MODES: tuple[Mode, ...] = get_args(Mode)
_MIDDLE = 127  # 255 P of unknown, `trinary`: what is known keeps to its side of it
_RAW_UNKNOWN = 255  # `raw` holds P in percent; above 100 is unknown
_THRESHOLDS = {"trinary": (0.5, 0.496), "scale": (1.0, 0.0), "raw": (0.5, 0.496)}  # occupied, free


def suffix_of(mode: Mode) -> str:
    """`.pgm`; `.png` for `scale`, where only transparency says unknown."""
    if mode not in MODES:
        raise InputError(f"{mode!r}", field="mode", valid=", ".join(MODES))
    return ".png" if mode == "scale" else ".pgm"


def image_of(grid: Grid2D, mode: Mode = "trinary") -> bytes:
    """The image's bytes, north up.

    Read back by map_server's formula, P is off by at most 1/255 (`raw`: 1/200). `trinary` gives
    free (P < 0.5), occupied and unknown as the map has them; `scale` gives P in percent.
    """
    suffix = suffix_of(mode)
    p = grid.probability.T[::-1]  # rows from north to south, columns to the east
    known = np.isfinite(p)
    p = np.where(known, p, 0.5)
    if mode == "raw":
        return _pgm(np.where(known, np.rint(100 * p), _RAW_UNKNOWN).astype(np.uint8))
    shade = (255 - np.rint(255 * p)).astype(np.uint8)
    if suffix == ".png":
        return _png(np.stack([shade, np.where(known, 255, 0).astype(np.uint8)], axis=2))
    return _pgm(_three_ways(shade, known, p))


def yaml_of(grid: Grid2D, image_name: str, mode: Mode = "trinary") -> str:
    """The text of the YAML file beside the image."""
    occupied, free = _THRESHOLDS[mode]
    x, y = (round(float(v), 9) + 0.0 for v in grid.origin_xy)
    return (
        f"image: {image_name}\nmode: {mode}\nresolution: {grid.resolution_m!r}\norigin: [{x!r}, {y!r}, 0.0]\n"
        f"negate: 0\noccupied_thresh: {occupied}\nfree_thresh: {free}\n"
    )


def _three_ways(shade: NDArray[np.uint8], known: NDArray[np.bool_], p: Array32) -> NDArray[np.uint8]:
    """Occupied is darker than the middle, free lighter, unknown that very shade."""
    middle = 255 - _MIDDLE
    sided = np.where(p >= 0.5, np.minimum(shade, middle - 1), np.maximum(shade, middle + 1))
    return np.where(known, sided, middle).astype(np.uint8)


def _pgm(shades: NDArray[np.uint8]) -> bytes:
    height, width = shades.shape
    return f"P5\n{width} {height}\n255\n".encode() + shades.tobytes()


def _png(shades: NDArray[np.uint8]) -> bytes:
    """`shades` (H, W, 2): grey and opacity."""
    out = BytesIO()
    Image.fromarray(shades).save(out, "PNG")
    return out.getvalue()
