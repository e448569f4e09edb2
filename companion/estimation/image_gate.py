"""Which images may be tracked: not the dark, the blurred, or the same one again."""

from __future__ import annotations

from typing import Annotated

import cv2
import msgspec
import numpy as np

from companion.core.messages import Bytes2D

Positive = Annotated[float, msgspec.Meta(gt=0)]


class ImageGateConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """What an image must have."""

    contrast: Positive = 4.0  # standard deviation of the grey values
    sharpness: Positive = 0.25  # mean square of the Laplacian over its usual value
    usual_share: Annotated[float, msgspec.Meta(gt=0, le=1)] = 0.05  # of a good image in the usual value
    doubt_share: Annotated[float, msgspec.Meta(gt=0, le=1)] = 0.02  # the same of a blurred one: 5 s until it is usual


class ImageGate:
    """Remembers the last image and the usual sharpness (Laplacian energy: S. Pertuz et al., PR 2013)."""

    def __init__(self, config: ImageGateConfig) -> None:
        self._config = config
        self._last: Bytes2D | None = None
        self._usual = 0.0

    def objection(self, pixels: Bytes2D) -> str:
        """Why this image is not to be used; "": it is good."""
        same = self._last is not None and np.array_equal(self._last, pixels)
        self._last = pixels
        if same:
            return "camera frozen"  # noise makes every true image another one
        if float(cv2.meanStdDev(pixels)[1][0, 0]) < self._config.contrast:
            return "camera dark"
        return self._blur(pixels)

    def _blur(self, pixels: Bytes2D) -> str:
        sharpness = cv2.norm(cv2.Laplacian(pixels, cv2.CV_16S), cv2.NORM_L2SQR) / pixels.size
        blurred = sharpness < self._config.sharpness * self._usual
        share = self._config.doubt_share if blurred else self._config.usual_share
        self._usual = self._usual + share * (sharpness - self._usual) if self._usual else sharpness
        return "camera blurred" if blurred else ""
