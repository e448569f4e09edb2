"""Points of an image that can be known again: ORB, spread over the image.

Source: E. Rublee et al., "ORB: an efficient alternative to SIFT or SURF", ICCV 2011 (OpenCV's).
"""

from __future__ import annotations

from typing import Annotated

import cv2
import msgspec
import numpy as np
from numpy.typing import NDArray

from companion.core.messages import Array, Bytes2D
from companion.mapping.association import DESCRIPTOR_BYTES

cv2.setNumThreads(1)  # same bits every time, and the other cores are not ours

_Count = Annotated[int, msgspec.Meta(ge=1)]
_PATCH_PX = 31  # side of the patch that a descriptor looks at
_EDGE_PX = 20  # its half diagonal, so that it stays inside the image at any turn


class KeypointConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """How many points, and where."""

    candidates: _Count = 150  # best corners of the whole image, of which each cell takes its own
    cell_px: Annotated[int, msgspec.Meta(ge=8)] = 40  # side of a cell
    per_cell: _Count = 3  # points at most
    levels: Annotated[int, msgspec.Meta(ge=1, le=12)] = 3  # of the pyramid
    scale: Annotated[float, msgspec.Meta(gt=1.0, le=2.0)] = 1.4  # from level to level
    corner_threshold: Annotated[int, msgspec.Meta(ge=1, le=255)] = 30  # grey levels around a corner (FAST)


class Keypoints:
    """Finds and describes.

    >>> uv_px, descriptors = Keypoints(KeypointConfig()).find(image.pixels)
    """

    def __init__(self, config: KeypointConfig) -> None:
        self.config = config
        self._orb = cv2.ORB_create(  # type: ignore[attr-defined]
            nfeatures=config.candidates,
            scaleFactor=config.scale,
            nlevels=config.levels,
            edgeThreshold=_EDGE_PX,
            patchSize=_PATCH_PX,
            fastThreshold=config.corner_threshold,
        )

    def find(self, pixels: Bytes2D) -> tuple[Array, Bytes2D]:
        """Image points (K, 2), px, first pixel [0, 1) x [0, 1), and descriptors (K, 32) of a grey image (H, W)."""
        found = self._orb.detect(pixels, None)
        kept = [found[i] for i in self._spread(found)]
        kept, bits = self._orb.compute(pixels, kept)
        if bits is None or len(kept) == 0:
            return np.empty((0, 2)), np.empty((0, DESCRIPTOR_BYTES), np.uint8)
        uv = np.array([k.pt for k in kept]) + 0.5  # OpenCV: the centre of the first pixel is 0
        return uv, np.asarray(bits, np.uint8)

    def _spread(self, found: tuple[cv2.KeyPoint, ...]) -> NDArray[np.int64]:
        """Numbers of the strongest `per_cell` of each cell, cell by cell."""
        if not found:
            return np.empty(0, np.int64)
        uv = np.array([k.pt for k in found])
        strength = np.array([k.response for k in found])
        column, row = (uv // self.config.cell_px).astype(np.int64).T
        order = np.lexsort((uv[:, 0], uv[:, 1], -strength, column, row))
        cell = row[order] * 100_000 + column[order]
        first = np.concatenate([[True], np.diff(cell) != 0])
        place = np.arange(len(cell)) - np.flatnonzero(first)[np.cumsum(first) - 1]
        return np.asarray(order[place < self.config.per_cell])
