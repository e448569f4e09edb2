"""Barometer: height above an arbitrary zero that drifts with the weather and the sensor's warmth."""

from __future__ import annotations

import math
from typing import Annotated

import msgspec
import numpy as np

from companion.core.messages import BaroReading

NotNegative = Annotated[float, msgspec.Meta(ge=0)]
Positive = Annotated[float, msgspec.Meta(gt=0)]


class BaroConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """BMP388 class: 0.03 Pa rms is 3 mm; in the rotors' wash decimetres are usual."""

    rate_hz: Positive = 20.0
    noise_m: NotNegative = 0.1  # white, per sample
    drift_m: NotNegative = 1.0  # standard deviation of the slow drift (first-order Gauss-Markov)
    drift_time_s: Positive = 600.0
    zero_m: float = 0.0  # reading at world z = 0 before drift


class Baro:
    """One barometer; the drift begins at 0."""

    def __init__(self, config: BaroConfig, *, seed: int, stream: int = 0) -> None:
        self.config = config
        self._rng = np.random.default_rng([seed, 4, stream])
        self._drift_m = 0.0
        self._last_ns = 0

    def sample(self, stamp_ns: int, z_world: float) -> BaroReading:
        """Reading at a true height, m; stamps may not go back."""
        c = self.config
        keep = math.exp(-(stamp_ns - self._last_ns) * 1e-9 / c.drift_time_s)
        self._last_ns = stamp_ns
        drift, noise = self._rng.standard_normal(2)
        self._drift_m = keep * self._drift_m + c.drift_m * math.sqrt(1.0 - keep * keep) * drift
        altitude = z_world + c.zero_m + self._drift_m + c.noise_m * noise
        return BaroReading(stamp_ns=stamp_ns, altitude_m=float(altitude))
