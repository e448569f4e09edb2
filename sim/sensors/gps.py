"""GPS: white noise, multipath that wanders and grows under a canopy, and denial.

Multipath is a first-order Gauss-Markov process whose deviation goes from that of the open sky
to that of a closed canopy. Not modelled: single satellites, jumps at changes of constellation.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

import msgspec
import numpy as np

from companion.core.messages import Array

NotNegative = Annotated[float, msgspec.Meta(ge=0)]
Positive = Annotated[float, msgspec.Meta(gt=0)]


class GpsConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Single-frequency receiver (u-blox M9 class: 1.5 m CEP in the open).

    Under a closed canopy studies find 5-10 m with such receivers.
    """

    denied: bool = True  # no fix at all
    rate_hz: Positive = 5.0
    noise_horizontal_m: NotNegative = 0.3  # white, per axis and fix
    noise_vertical_m: NotNegative = 0.6
    multipath_open_m: NotNegative = 0.8  # per horizontal axis; 1.5 times that vertically
    multipath_canopy_m: NotNegative = 5.0
    multipath_time_s: Positive = 60.0
    noise_velocity_m_s: NotNegative = 0.1
    canopy_loss: Annotated[float, msgspec.Meta(ge=0, le=1)] = 0.3  # share of fixes lost under closed canopy


@dataclass(frozen=True, slots=True)
class GpsFix:
    """One fix in the world frame; converting to latitude and longitude is the autopilot's business."""

    stamp_ns: int
    p_world: Array  # (3,)
    v_world: Array  # (3,)
    sigma_horizontal_m: float  # what the receiver claims, per axis
    sigma_vertical_m: float


class Gps:
    """One receiver."""

    def __init__(self, config: GpsConfig, *, seed: int) -> None:
        self.config = config
        self._rng = np.random.default_rng([seed, 6])
        self._multipath = self._rng.standard_normal(3)  # in units of its deviation
        self._last_ns = 0
        self._jump: Array = np.zeros(3)

    def jump(self, offset_world_m: Array) -> None:
        """Fault: all later fixes are off by this (3,), m; zeros end it."""
        self._jump = np.array(offset_world_m, dtype=np.float64)

    def sample(self, stamp_ns: int, p_world: Array, v_world: Array, *, canopy: float = 0.0) -> GpsFix | None:
        """A fix, or None when there is none; `canopy` is the share of sky covered, 0 to 1."""
        c = self.config
        keep = math.exp(-(stamp_ns - self._last_ns) * 1e-9 / c.multipath_time_s)
        self._last_ns = stamp_ns
        normals = self._rng.standard_normal(9)
        self._multipath = keep * self._multipath + math.sqrt(1.0 - keep * keep) * normals[:3]
        if self._rng.uniform() < c.canopy_loss * canopy or c.denied:
            return None
        wander = c.multipath_open_m + canopy * (c.multipath_canopy_m - c.multipath_open_m)
        axes = np.array([1.0, 1.0, 1.5]) * wander
        white = np.array([c.noise_horizontal_m, c.noise_horizontal_m, c.noise_vertical_m])
        return GpsFix(
            stamp_ns=stamp_ns,
            p_world=p_world + self._jump + axes * self._multipath + white * normals[3:6],
            v_world=v_world + c.noise_velocity_m_s * normals[6:],
            sigma_horizontal_m=math.hypot(wander, c.noise_horizontal_m),
            sigma_vertical_m=math.hypot(1.5 * wander, c.noise_vertical_m),
        )
