"""Places as commands, mission items and global setpoints name them -> the local frame."""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from companion.core.messages import Array
from sim.autopilot.frames import local

INT32_UNSET: Final = 0x7FFFFFFF
LOCAL_FRAMES: Final = (1, 20)  # LOCAL_NED, LOCAL_FRD
RELATIVE_FRAMES: Final = (3, 6)  # GLOBAL_RELATIVE_ALT, GLOBAL_RELATIVE_ALT_INT: above home

Origin = tuple[float, float, float]  # latitude and longitude in degrees, altitude in m


def from_integers(frame: int, x: int, y: int) -> tuple[float, float]:
    """Scaled integers of 1e-7 degrees or 1e-4 m -> degrees or m; unset is NaN."""
    if INT32_UNSET in (x, y):
        return math.nan, math.nan
    scale = 1e-4 if frame in LOCAL_FRAMES else 1e-7
    return x * scale, y * scale


def place(origin: Origin, home: Array, frame: int, xyz: tuple[float, float, float]) -> Array:
    """p_ned (3,) of north, east, down, or of degrees and an altitude; unset components are NaN."""
    x, y, z = xyz
    if frame in LOCAL_FRAMES:
        return np.array([x, y, z])
    altitude = z + origin[2] - float(home[2]) if frame in RELATIVE_FRAMES else z
    return local(origin, x, y, altitude)
