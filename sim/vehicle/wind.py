"""Wind: a mean with shear, and gusts that a moving aircraft flies through.

Mean over open ground: logarithmic law. Under a canopy of height h: U(h) exp(a (z / h - 1))
(Cionco, 1965); above it the logarithmic law with displacement 0.7 h and roughness 0.1 h.
Gusts: one Ornstein-Uhlenbeck process per axis, the first-order Dryden form
(MIL-F-8785C), with time scale L / max(airspeed, 1 m/s); their strength follows the mean's profile.
"""

from __future__ import annotations

import math
from typing import Annotated

import msgspec
import numpy as np
from numba import njit

from companion.core.messages import Array

NotNegative = Annotated[float, msgspec.Meta(ge=0)]
Positive = Annotated[float, msgspec.Meta(gt=0)]


class WindConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Speeds are those at `reference_height_m` above ground or, if there is one, above the canopy."""

    mean_m_s: NotNegative = 0.0
    heading_deg: float = 0.0  # towards which it blows, from +x (east) towards +y
    gust_m_s: NotNegative = 0.0  # standard deviation per horizontal axis
    gust_vertical_ratio: NotNegative = 0.5  # vertical over horizontal deviation
    gust_length_m: Positive = 10.0  # L of the Dryden spectrum
    reference_height_m: Positive = 10.0
    roughness_m: Positive = 0.03  # z0 of open ground
    canopy_height_m: NotNegative = 0.0  # 0: open ground
    canopy_attenuation: NotNegative = 2.5  # a; 2-4 in forests


WIND_SIZE = 9  # packed: mean x, mean y, gust, vertical gust, length, reference, z0, canopy, attenuation


def pack_wind(config: WindConfig) -> Array:
    """Figures (9,) for the kernel."""
    heading = math.radians(config.heading_deg)
    return np.array(
        [
            config.mean_m_s * math.cos(heading),
            config.mean_m_s * math.sin(heading),
            config.gust_m_s,
            config.gust_m_s * config.gust_vertical_ratio,
            config.gust_length_m,
            config.reference_height_m,
            config.roughness_m,
            config.canopy_height_m,
            config.canopy_attenuation,
        ]
    )


def wind_profile(config: WindConfig, height_m: float) -> float:
    """Mean wind at a height above ground over that at the reference height."""
    return float(_profile(pack_wind(config), height_m))


@njit(cache=True, nogil=True)
def _profile(wind, height):  # type: ignore[no-untyped-def]
    reference, z0, canopy = wind[5], wind[6], wind[7]
    if canopy <= 0.0:
        return math.log1p(max(height, 0.0) / z0) / math.log1p(reference / z0)
    z0, base = 0.1 * canopy, 0.7 * canopy
    top = math.log((canopy + reference - base) / z0)
    if height >= canopy:
        return math.log((height - base) / z0) / top
    return math.log((canopy - base) / z0) / top * math.exp(wind[8] * (max(height, 0.0) / canopy - 1.0))


@njit(cache=True, nogil=True)
def _blow(wind, gust, normals, height, velocity, dt, out):  # type: ignore[no-untyped-def]
    """Advance the unit gusts (3,) by one step and write the wind at the aircraft, world frame."""
    share = _profile(wind, height)
    dx, dy = velocity[0] - share * wind[0], velocity[1] - share * wind[1]
    airspeed = math.sqrt(dx * dx + dy * dy + velocity[2] * velocity[2])
    keep = math.exp(-dt * max(airspeed, 1.0) / wind[4])
    fresh = math.sqrt(1.0 - keep * keep)
    for i in range(3):
        gust[i] = keep * gust[i] + fresh * normals[i]
    out[0] = share * (wind[0] + wind[2] * gust[0])
    out[1] = share * (wind[1] + wind[2] * gust[1])
    out[2] = share * wind[3] * gust[2]
