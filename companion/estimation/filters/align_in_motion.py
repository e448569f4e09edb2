"""Start in motion: attitude, velocity and position from a few seconds of IMU and position fixes, by least squares.

In the body frame of the start, the doubly integrated specific force s(t) is known; in the world

    p(t) = p0 + v0 t + g t^2 / 2 + R s(t),

which is linear in R, v0 and p0. R is solved for freely, brought to the nearest rotation, and the
rest solved again. Biases are neglected, so the window must be short. Source: the closed-form start
of visual-inertial systems (A. Martinelli, "Closed-form solution of visual-inertial structure from
motion", IJCV 2014), with fixes instead of features.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from companion.core.errors import InputError
from companion.core.messages import Array
from companion.estimation.propagation import NODE, propagate
from companion.estimation.state import ERROR, State

_FEWEST = 6


@dataclass(frozen=True, slots=True)
class Alignment:
    """The state at the window's start."""

    state: State
    rms_m: float  # of the fixes against it


def align_in_motion(imu: Array, fix_s: Array, fix_p: Array, *, gravity_m_s2: float) -> Alignment:
    """Align IMU pieces (N, 7) with fixes (M, 3) at `fix_s` (M,) seconds after the first piece's start.

    Raises InputError if fewer than six fixes lie within the pieces.
    """
    path = _force_path(imu)
    inside = (fix_s >= path[0, 0]) & (fix_s <= path[-1, 0])
    if np.count_nonzero(inside) < _FEWEST:
        raise InputError(f"{np.count_nonzero(inside)} within the IMU's time", field="fixes", valid=f">= {_FEWEST}")
    t, p = fix_s[inside], fix_p[inside]
    s = np.column_stack([np.interp(t, path[:, 0], path[:, 1 + k]) for k in range(3)])
    free_of_gravity = p - 0.5 * t[:, None] ** 2 * np.array([0.0, 0.0, -gravity_m_s2])
    line = np.column_stack([t, np.ones_like(t)])
    solved = np.linalg.lstsq(np.column_stack([s, line]), free_of_gravity, rcond=None)[0]
    state = State.at_rest(gravity_m_s2)
    state.R[:] = _nearest_rotation(solved[:3].T)
    rest = free_of_gravity - s @ state.R.T
    motion = np.linalg.lstsq(line, rest, rcond=None)[0]
    state.v[:], state.p[:] = motion
    return Alignment(state, float(np.sqrt(((rest - line @ motion) ** 2).sum(axis=1).mean())))


def _force_path(imu: Array) -> Array:
    """Time and doubly integrated specific force in the frame of the start, (N, 4)."""
    state = State.at_rest(0.0)
    nodes = propagate(state, np.zeros((ERROR, ERROR)), imu, np.zeros(4), t_s=0.0)
    last = np.zeros((1, NODE))
    last[0, 0], last[0, 10:13] = imu[:, 0].sum(), state.p
    nodes = np.concatenate([nodes, last])
    return np.column_stack([nodes[:, 0], nodes[:, 10:13]])


def _nearest_rotation(M: Array) -> Array:
    """Orthogonal Procrustes (P. Schoenemann, 1966), without reflections."""
    U, _, Vt = np.linalg.svd(M)
    rotation: Array = (U * [1.0, 1.0, np.sign(np.linalg.det(U @ Vt))]) @ Vt
    return rotation
