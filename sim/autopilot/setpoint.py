"""SET_POSITION_TARGET_LOCAL_NED as PX4 reads it: every ignored axis becomes NaN."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from companion.core.messages import Array

LOCAL_NED, BODY_NED = 1, 8
FORCE_BIT, YAW_BIT, YAW_RATE_BIT = 1 << 9, 1 << 10, 1 << 11
P, V, A, YAW, YAW_RATE = slice(0, 3), slice(3, 6), slice(6, 9), 9, 10
SIZE = 11


class Refused(NamedTuple):
    """Why a setpoint is not used; the text of the warning."""

    text: str


def read_setpoint(values: tuple[Any, ...], own_yaw: float) -> Array | Refused:
    """The flat fields of the message -> setpoint NED (11,): p, v, a, yaw, yaw rate, NaN: not controlled.

    Frames 1 (LOCAL_NED) and 8 (BODY_NED: velocity and acceleration turned by the heading, no
    position) only. Needs any of position, velocity, acceleration; force setpoints are refused.
    """
    mask, frame = values[12], values[15]
    setpoint = np.array(values[1:12])
    for axis in range(9):
        if mask >> axis & 1:
            setpoint[axis] = np.nan
    if mask & YAW_BIT:
        setpoint[YAW] = np.nan
    if mask & YAW_RATE_BIT:
        setpoint[YAW_RATE] = np.nan
    if frame not in (LOCAL_NED, BODY_NED):
        return Refused(f"SET_POSITION_TARGET_LOCAL_NED coordinate frame {frame} unsupported")
    if frame == BODY_NED:
        setpoint[P] = np.nan
        setpoint[V] = _turn(setpoint[V], own_yaw)
        setpoint[A] = _turn(setpoint[A], own_yaw)
    setpoint[~np.isfinite(setpoint)] = np.nan
    if mask & FORCE_BIT and not np.isnan(setpoint[A]).all():
        return Refused("SET_POSITION_TARGET_LOCAL_NED force not supported")
    if np.isnan(setpoint[:9]).all():
        return Refused("SET_POSITION_TARGET_LOCAL_NED invalid")
    return setpoint


def complete(setpoint: Array) -> bool:
    """Whether every axis has a demand and the horizontal ones come in pairs, as PX4's controller requires."""
    given = ~np.isnan(setpoint[:9].reshape(3, 3))  # rows p, v, a
    pairs = (given[:, 0] == given[:, 1]).all()
    return bool(given.any(axis=0).all() and pairs)


def stop() -> Array:
    """What PX4 flies instead of an incomplete setpoint: velocity zero."""
    setpoint = np.full(SIZE, np.nan)
    setpoint[V] = 0.0
    return setpoint


def _turn(v: Array, yaw: float) -> Array:
    c, s = math.cos(yaw), math.sin(yaw)
    x, y = (0.0 if math.isnan(a) else a for a in v[:2])
    turned = np.array([c * x - s * y, s * x + c * y, v[2]])
    if np.isnan(v[:2]).all():
        turned[:2] = np.nan
    return turned
