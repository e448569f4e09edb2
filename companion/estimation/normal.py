"""What a measurement says of the pose, as normal equations, and along which axes it says hardly anything."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from companion.core.messages import Array

LEVER = np.diag([0.1, 0.1, 0.1, 1.0, 1.0, 1.0])  # 1/m: rotation counts by its effect 10 m away


@dataclass(frozen=True, slots=True)
class Normal:
    """0.5 dx' H dx - g' dx at a pose, dx = (theta_body, p_odom)."""

    R: Array  # (3, 3), where it was linearised
    p: Array  # (3,)
    H: Array  # (6, 6)
    g: Array  # (6,)
    used: int
    offered: int

    @property
    def weakest(self) -> float:
        """Smallest eigenvalue of the scaled information, 0..1/3: near 0, a direction is blind."""
        return float(np.linalg.eigvalsh(LEVER @ self.H @ LEVER / self.scale)[0]) if self.scale > 0 else 0.0

    @property
    def scale(self) -> float:
        """Sum of the information on position, 1/m2: eigenvalues are compared with it."""
        return float(np.trace(self.H[3:, 3:]))

    @property
    def in_odom(self) -> Array:
        """Information (6, 6) on turn and shift in odom, in levers, 1/m2."""
        turn = turned(self.R)
        return np.asarray(turn @ LEVER @ self.H @ LEVER @ turn.T)

    def weak_axes(self, below: float) -> list[str]:
        """Names of the directions in which it says hardly anything, in odom: an axis, or a turn about one."""
        if self.scale <= 0:
            return ["every axis"]
        values, vectors = np.linalg.eigh(LEVER @ self.H @ LEVER / self.scale)
        return [_named(v, self.R) for v in vectors[:, values < below].T]


def turned(R: Array) -> Array:
    """Of a turn in the body and a shift in odom, (6, 6), to both in odom."""
    turn = np.eye(6)
    turn[:3, :3] = R
    return turn


def _named(direction: Array, R: Array) -> str:
    """Of a unit vector (6,) in lever coordinates: what of it is larger, shift or turn."""
    turn, shift = R @ direction[:3], direction[3:]
    is_shift = np.linalg.norm(shift) >= np.linalg.norm(turn)
    axis = shift if is_shift else turn
    x, y, z = axis / np.linalg.norm(axis) * (np.sign(axis[np.argmax(np.abs(axis))]) or 1.0)
    return f"{'position along' if is_shift else 'turn about'} ({x:.1f} {y:.1f} {z:.1f})"
