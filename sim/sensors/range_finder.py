"""Downward range finder: one beam along its mount's axis, with noise, limits and lost echoes."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Annotated

import msgspec
import numpy as np

from companion.core.geometry import rotation_from_quaternion
from companion.core.messages import Array, RangeReading
from companion.core.rig import Mount

NotNegative = Annotated[float, msgspec.Meta(ge=0)]
Positive = Annotated[float, msgspec.Meta(gt=0)]
Fraction = Annotated[float, msgspec.Meta(ge=0, le=1)]
RangeToSurface = Callable[[Array, Array], float]  # start and unit direction, world -> m; inf: nothing


class RangeFinderConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Small laser altimeter (Benewake TF02-Pro class)."""

    rate_hz: Positive = 20.0
    range_min_m: NotNegative = 0.05
    range_max_m: Positive = 20.0
    noise_m: NotNegative = 0.02  # white, per sample
    noise_per_m: NotNegative = 0.005  # grows with range, added in quadrature
    dropout: Fraction = 0.01  # share of echoes lost


class RangeFinder:
    """One sensor; looks along the -z axis of its mount."""

    def __init__(self, config: RangeFinderConfig, mount: Mount, *, seed: int) -> None:
        self.config = config
        self._p_body = mount.p_body
        self._axis_body = -mount.R_body_sensor[:, 2]
        self._rng = np.random.default_rng([seed, 5])

    def sample(
        self, stamp_ns: int, p_world: Array, q_world_body: Array, range_to_surface: RangeToSurface
    ) -> RangeReading:
        """Reading from the vehicle's true pose; NaN where nothing comes back."""
        c = self.config
        R = rotation_from_quaternion(q_world_body)
        true_m = range_to_surface(p_world + R @ self._p_body, R @ self._axis_body)
        lost, noise = self._rng.uniform(), self._rng.standard_normal()
        if lost < c.dropout or not c.range_min_m <= true_m <= c.range_max_m:
            return RangeReading(stamp_ns=stamp_ns, range_m=math.nan)
        measured = true_m + math.hypot(c.noise_m, c.noise_per_m * true_m) * noise
        return RangeReading(stamp_ns=stamp_ns, range_m=float(max(measured, 0.0)))
