"""A warehouse in plan for the study of localisation: racks that are all alike, a few things that are not.

Segments stand for walls; a level scanner sees them; the prior map is points along them.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from companion.core.messages import Array

SIZE_M = (56.0, 34.0)
RACK_M, AISLE_M, RACKS = (20.0, 1.2), 3.0, 7
BLOCKS_X = (5.0, 31.0)  # two blocks of racks with a cross aisle between
FIRST_Y = 3.6
RANGE_M, BEAMS, RANGE_SIGMA_M = 9.0, 90, 0.02
STEP_S, SPEED_M_S, TURN_RAD = 0.2, 1.5, 0.25


@dataclass(frozen=True, slots=True)
class Step:
    """One step of a drive: the truth, and what odometry and scanner say of it."""

    truth: Array  # x, y, z, yaw after the step, (4,)
    odometry: Array  # (3,), m, in the frame of the pose before
    turn_rad: float
    scan: Array  # (M, 3), level frame, m
    carried: bool = False  # odometry missed a leap


def segments() -> Array:
    """Walls, racks and the few singular things, (S, 4): x0 y0 x1 y1."""
    boxes = [(0.0, 0.0, *SIZE_M)]
    for x in BLOCKS_X:
        boxes += [(x, y, x + RACK_M[0], y + RACK_M[1]) for y in rack_rows()]
    boxes += [(52.0, 0.0, 56.0, 5.0), (0.0, 29.5, 2.5, 34.0), (27.7, 30.8, 28.3, 31.4), (53.5, 20.0, 54.1, 20.6)]
    return np.array([side for box in boxes for side in _sides(*box)])


def rack_rows() -> Array:
    """Lower edge of each row of racks, m."""
    rows: Array = FIRST_Y + np.arange(RACKS, dtype=np.float64) * (RACK_M[1] + AISLE_M)
    return rows


def _sides(x0: float, y0: float, x1: float, y1: float) -> list[tuple[float, float, float, float]]:
    return [(x0, y0, x1, y0), (x1, y0, x1, y1), (x1, y1, x0, y1), (x0, y1, x0, y0)]


def known_points(walls: Array, *, spacing_m: float = 0.05) -> Array:
    """Points (N, 2) along the walls: what a saved map holds."""
    parts = []
    for x0, y0, x1, y1 in walls:
        count = int(np.hypot(x1 - x0, y1 - y0) / spacing_m) + 2
        parts.append(np.column_stack([np.linspace(x0, x1, count), np.linspace(y0, y1, count)]))
    return np.concatenate(parts)


def free_poses(rng: np.random.Generator, count: int) -> Array:
    """Poses (N, 4) uniform over the free floor and all headings."""
    poses = np.zeros((0, 4))
    while len(poses) < count:
        p = rng.uniform((0.4, 0.4), (SIZE_M[0] - 0.4, SIZE_M[1] - 0.4), (2 * count, 2))
        p = p[~_in_rack(p)]
        poses = np.concatenate([poses, np.column_stack([p, np.zeros(len(p)), rng.uniform(-np.pi, np.pi, len(p))])])
    return poses[:count]


def _in_rack(p: Array) -> NDArray[np.bool_]:
    inside = np.zeros(len(p), bool)
    for x in BLOCKS_X:
        for y in rack_rows():
            off = (p - (x, y) > -0.3) & (p - (x, y) < np.array(RACK_M) + 0.3)
            inside |= off.all(axis=1)
    return inside


def aisle_y(k: int) -> float:
    """Middle of aisle k (0 .. 5), between racks k and k + 1."""
    return float(rack_rows()[k] + RACK_M[1] + 0.5 * AISLE_M)


def scan(pose: Array, walls: Array, rng: np.random.Generator) -> Array:
    """Returns of a level scanner (M, 3), m, in the level frame at `pose`."""
    angles = np.linspace(-np.pi, np.pi, BEAMS, endpoint=False)
    world = angles + pose[3]
    d = np.column_stack([np.cos(world), np.sin(world)])[:, None]
    a, e = walls[:, :2] - pose[:2], walls[:, 2:] - walls[:, :2]
    cross = d[..., 0] * e[:, 1] - d[..., 1] * e[:, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        t = (a[:, 0] * e[:, 1] - a[:, 1] * e[:, 0]) / cross
        u = (a[:, 0] * d[..., 1] - a[:, 1] * d[..., 0]) / cross
    ranges = np.where((t > 0) & (u >= 0) & (u <= 1), t, np.inf).min(axis=1)
    seen = ranges < RANGE_M
    r = ranges[seen] + rng.normal(0.0, RANGE_SIGMA_M, int(seen.sum()))
    return np.column_stack([r * np.cos(angles[seen]), r * np.sin(angles[seen]), np.zeros(len(r))])


def drive(
    waypoints: Array, walls: Array, rng: np.random.Generator, *, leap: tuple[int, int] | None = None
) -> Iterator[Step]:
    """Along the waypoints (K, 2), heading ahead. `leap` (a, b): carried from a to b, unseen by odometry.

    Odometry has a scale error of 2 % and a drift of heading of 0.2 deg per step, drawn once, and noise of each step.
    """
    scale, drift = 1.0 + rng.normal(0.0, 0.02), rng.normal(0.0, 0.0035)
    first = waypoints[1] - waypoints[0]
    pose = np.array([*waypoints[0], 0.0, np.arctan2(first[1], first[0])])
    yield Step(pose.copy(), np.zeros(3), 0.0, scan(pose, walls, rng))
    k, carried = 1, False
    while k < len(waypoints):
        if leap is not None and k == leap[0]:
            pose[:2], k, leap, carried = waypoints[leap[1]], leap[1] + 1, None, True
        before = pose.copy()
        way = waypoints[k] - pose[:2]
        turn = np.arctan2(*way[::-1]) - pose[3]
        turn = float(np.clip(np.arctan2(np.sin(turn), np.cos(turn)), -TURN_RAD, TURN_RAD))
        length = min(SPEED_M_S * STEP_S, float(np.linalg.norm(way)))
        pose[:2] += way / max(float(np.linalg.norm(way)), 1e-9) * length
        pose[3] += turn
        k += int(np.linalg.norm(waypoints[k] - pose[:2]) < 0.05)
        c, s = np.cos(before[3]), np.sin(before[3])
        body = np.array([[c, s], [-s, c]]) @ (pose[:2] - before[:2])
        noisy = scale * body + rng.normal(0.0, 0.01 + 0.03 * length, 2)
        seen_turn = turn + drift + float(rng.normal(0.0, 0.005))
        yield Step(pose.copy(), np.array([*noisy, 0.0]), seen_turn, scan(pose, walls, rng), carried)
        carried = False
