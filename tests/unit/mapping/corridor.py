"""A square corridor with poles, flown around by a LiDAR of 720 beams; the way as it is and as drift bends it."""

import functools

import numpy as np

from companion.core.geometry import quaternion_from_yaw, rotation_from_quaternion
from companion.mapping.voxel_map import VoxelMapConfig

CONFIG = VoxelMapConfig(max_range_m=10.0, miss_clear_range_m=5.0)
OUTER, INNER, MIDDLE = 12.0, 6.0, 9.0  # half edges of the walls, and of the way
POLES = np.array([[11.0 * np.cos(a), 11.0 * np.sin(a)] for a in np.arange(24) * np.pi / 12 if abs(np.sin(2 * a)) > 0.1])
POLE_RADIUS = 0.15
STEP_NS = 10**8


def way(step_m=0.5, rounds=1.2):
    """(p (N, 3), yaw (N,)): counter-clockwise around the square, facing ahead."""
    s = np.arange(0.0, 8 * MIDDLE * rounds, step_m)
    side, along = (s // (2 * MIDDLE)).astype(int) % 4, s % (2 * MIDDLE) - MIDDLE
    corner = [(along, -MIDDLE), (MIDDLE, along), (-along, MIDDLE), (-MIDDLE, -along)]
    p = np.array([[*(float(np.broadcast_to(c, s.shape)[k]) for c in corner[side[k]]), 1.5] for k in range(len(s))])
    return p, side * np.pi / 2


def drifted(p, yaw, *, turn=0.02, stretch=1.01):
    """The way as odometry with a growing heading error, rad at the end, and a scale error believes it."""
    error = np.linspace(0.0, turn, len(p))
    c, s = np.cos(error[1:]), np.sin(error[1:])
    d = np.diff(p, axis=0) * stretch
    moved = np.stack([c * d[:, 0] - s * d[:, 1], s * d[:, 0] + c * d[:, 1], d[:, 2]], axis=1)
    return np.vstack([p[:1], p[0] + np.cumsum(moved, axis=0)]), yaw + error


def anchored(p, yaw, at_p, at_yaw):
    """The whole way moved so that its end is at another pose."""
    turn = rotation_from_quaternion(quaternion_from_yaw(at_yaw - yaw[-1]))
    return (p - p[-1]) @ turn.T + at_p, yaw + at_yaw - yaw[-1]


def quaternions(yaw):
    return np.array([quaternion_from_yaw(y) for y in yaw])


@functools.cache
def scan(number):
    """(returns, directions without one) in body axes of one sweep from a pose of the true way."""
    p, yaw = TRUE[0][number], TRUE[1][number]
    k = np.arange(720) + 720 * number
    azimuth, elevation = 2 * np.pi * ((k * 0.618034) % 1.0), np.radians(-20 + 50 * ((k * 0.754878) % 1.0))
    body = np.stack([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)], 1)
    d = body @ rotation_from_quaternion(quaternion_from_yaw(yaw)).T
    with np.errstate(divide="ignore", invalid="ignore"):
        outer = np.min((np.sign(d[:, :2]) * OUTER - p[:2]) / d[:, :2], axis=1)
        near, far = np.sort(np.stack([(s * INNER - p[:2]) / d[:, :2] for s in (-1, 1)]), axis=0)
        enter, leave = near.max(axis=1), far.min(axis=1)
        ranges = np.where((enter < leave) & (enter > 0), np.minimum(enter, outer), outer)
        flat2 = (d[:, :2] ** 2).sum(axis=1)
        for pole in POLES:
            b = d[:, :2] @ (pole - p[:2])
            root = b**2 - flat2 * (((pole - p[:2]) ** 2).sum() - POLE_RADIUS**2)
            t = np.where((root > 0) & (b > 0), (b - np.sqrt(np.maximum(root, 0))) / flat2, np.inf)
            ranges = np.minimum(ranges, t)
    seen = ranges < 20.0
    return (body[seen] * ranges[seen, None]).astype(np.float32), body[~seen].astype(np.float32)


TRUE = way()


def fly(voxels, submaps, believed, numbers, after=None):
    """Insert the scans `numbers`, taken on the true way, at the believed poses."""
    for k in numbers:
        returns, misses = scan(k)
        p, q = believed[0][k], quaternion_from_yaw(believed[1][k])
        voxels.insert(
            returns,
            R_odom_body=rotation_from_quaternion(q),
            p_odom=p,
            origin_odom=p,
            miss_dirs_body=misses,
            stamp_ns=k * STEP_NS,
            watch=submaps.watch if submaps else None,
        )
        done = after or (submaps.after_scan if submaps else None)
        if done:
            done(k * STEP_NS, p, q)
