"""Landing gear: four legs as springs and dampers on the ground, with friction that really holds.

The ground pushes straight up (its slope enters through the heights under the legs only).
Along the ground each leg is tied by a spring to the place where it touched down, its anchor,
as far as Coulomb friction allows; beyond that the anchor slides along.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit


@njit(cache=True, nogil=True)
def _leg_forces(m, x, R, ground_z, anchors):  # type: ignore[no-untyped-def]
    """Force and torque (6,) of the legs in the body frame; anchors (4, 2), NaN: not on the ground."""
    load = np.zeros(6)
    for i in range(4):
        leg = m.leg[i]
        px, py, pz, vx, vy, vz = _leg_motion(x, R, leg)
        sink = ground_z[1 + i] - pz
        if sink <= 0.0:
            continue
        up = max(m.k_leg * sink - m.c_leg * vz, 0.0)
        ax, ay = (px, py) if math.isnan(anchors[i, 0]) else (anchors[i, 0], anchors[i, 1])
        fx = m.k_leg * (ax - px) - m.c_leg * vx
        fy = m.k_leg * (ay - py) - m.c_leg * vy
        grip = math.sqrt(fx * fx + fy * fy)
        if grip > m.friction * up:
            fx *= m.friction * up / grip
            fy *= m.friction * up / grip
        bx = R[0, 0] * fx + R[1, 0] * fy + R[2, 0] * up
        by = R[0, 1] * fx + R[1, 1] * fy + R[2, 1] * up
        bz = R[0, 2] * fx + R[1, 2] * fy + R[2, 2] * up
        load[0] += bx
        load[1] += by
        load[2] += bz
        load[3] += leg[1] * bz - leg[2] * by
        load[4] += leg[2] * bx - leg[0] * bz
        load[5] += leg[0] * by - leg[1] * bx
    return load


@njit(cache=True, nogil=True)
def _settle_anchors(m, x, R, ground_z, anchors):  # type: ignore[no-untyped-def]
    """Set, drag along or lift the anchors after a step; returns how many legs stand."""
    standing = 0
    for i in range(4):
        px, py, pz, _, _, vz = _leg_motion(x, R, m.leg[i])
        sink = ground_z[1 + i] - pz
        if sink <= 0.0:
            anchors[i, 0] = np.nan
            continue
        standing += 1
        if math.isnan(anchors[i, 0]):
            anchors[i, 0], anchors[i, 1] = px, py
            continue
        reach = m.friction * max(m.k_leg * sink - m.c_leg * vz, 0.0) / m.k_leg
        dx, dy = anchors[i, 0] - px, anchors[i, 1] - py
        stretch = math.sqrt(dx * dx + dy * dy)
        if stretch > reach:
            anchors[i, 0] = px + dx * reach / stretch
            anchors[i, 1] = py + dy * reach / stretch
    return standing


@njit(cache=True, nogil=True)
def _leg_motion(x, R, leg):  # type: ignore[no-untyped-def]
    """Position and velocity of a leg's tip in the world."""
    wx, wy, wz = x[10], x[11], x[12]
    a = wy * leg[2] - wz * leg[1]
    b = wz * leg[0] - wx * leg[2]
    c = wx * leg[1] - wy * leg[0]
    return (
        x[0] + R[0, 0] * leg[0] + R[0, 1] * leg[1] + R[0, 2] * leg[2],
        x[1] + R[1, 0] * leg[0] + R[1, 1] * leg[1] + R[1, 2] * leg[2],
        x[2] + R[2, 0] * leg[0] + R[2, 1] * leg[1] + R[2, 2] * leg[2],
        x[3] + R[0, 0] * a + R[0, 1] * b + R[0, 2] * c,
        x[4] + R[1, 0] * a + R[1, 1] * b + R[1, 2] * c,
        x[5] + R[2, 0] * a + R[2, 1] * b + R[2, 2] * c,
    )
