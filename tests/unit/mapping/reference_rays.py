"""The textbook's way along a ray, to compare insertion with; and scans of a room."""

import numpy as np


def amanatides_woo(start, end, cell_m):
    """All voxels (tuples) from start to end."""
    a, b = start / cell_m, end / cell_m
    cell, last, d = np.floor(a).astype(int), np.floor(b).astype(int), b - a
    step = np.where(d > 0, 1, -1)
    with np.errstate(divide="ignore"):
        t_next = np.where(d > 0, cell + 1 - a, a - cell) / np.abs(d)
        t_step = 1 / np.abs(d)
    seen = [tuple(int(c) for c in cell)]
    for _ in range(int(np.abs(last - cell).sum())):
        axis = int(np.argmin(t_next))
        cell[axis] += step[axis]
        t_next[axis] += t_step[axis]
        seen.append(tuple(int(c) for c in cell))
    assert seen[-1] == tuple(last)
    return seen


def random_rotation(rng):
    q, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    return q * np.sign(np.linalg.det(q))


def random_scan(rng, returns, misses):
    """(points, directions of misses, R_odom_body, p_odom, origin_odom)."""
    R, p = random_rotation(rng), rng.uniform(-30, 30, 3)
    origin = p + R @ rng.uniform(-0.2, 0.2, 3)
    points = (rng.normal(size=(returns, 3)) * rng.uniform(0.1, 6, (returns, 1))).astype(np.float32)
    return points, rng.normal(size=(misses, 3)).astype(np.float32), R, p, origin


def expected_scan(scan, config):
    """(hit voxels, miss voxels) of a scan in a map of `config`."""
    points, misses, R, p, origin = scan
    hits, crossed = set(), set()
    for end in _ends(points, R, p, config):
        length = np.linalg.norm(end - origin)
        if length <= config.max_range_m:
            voxels = amanatides_woo(origin, end, config.resolution_m)
            hits.add(voxels[-1])
        else:
            end = origin + (end - origin) * config.max_range_m / length
            voxels = amanatides_woo(origin, end, config.resolution_m)
            voxels = voxels[:-1] or voxels
        crossed.update(voxels)
    for v in misses.astype(np.float64):
        end = origin + R @ v * config.miss_clear_range_m / np.linalg.norm(v)
        crossed.update(amanatides_woo(origin, end, config.resolution_m)[:-1])
    return hits, crossed - hits


def _ends(points, R, p, config):
    ends = points.astype(np.float64) @ R.T + p
    if config.ray_per == "point":
        return ends
    return (np.unique(np.floor(ends / config.resolution_m), axis=0) + 0.5) * config.resolution_m


def expected_map(scans, config, steps):
    """{voxel: steps} after all scans."""
    expected = {}
    for scan in scans:
        hits, crossed = expected_scan(scan, config)
        for group, step in ((hits, steps.hit), (crossed, steps.miss)):
            for voxel in sorted(group):
                level = expected.get(voxel, 0) + step
                expected[voxel] = min(max(level, steps.lowest), steps.highest)
    return expected


def known_voxels(voxels):
    """{voxel: steps} of every known voxel."""
    arrays = voxels.to_arrays()
    row, cell = np.nonzero(arrays["log_odds"] != -128)
    xyz = 8 * arrays["block_xyz"][row] + np.stack([cell >> 6, cell >> 3 & 7, cell & 7], axis=1)
    return dict(zip(map(tuple, xyz.tolist()), arrays["log_odds"][row, cell].tolist(), strict=True))


def room_scans(rng, count, returns):
    """(origin, returns in odom): on the walls of a box room with pillars, from a wandering sensor."""
    pillars = rng.uniform(-5, 5, (6, 2))
    for _ in range(count):
        origin = rng.uniform(-1.5, 1.5, 3)
        d = rng.normal(size=(returns, 3))
        d /= np.linalg.norm(d, axis=1, keepdims=True)
        with np.errstate(divide="ignore"):
            reach = np.min((np.sign(d) * [7.0, 6.0, 2.5] - origin) / d, axis=1)
        for pillar in pillars:
            offset, flat = pillar - origin[:2], d[:, :2]
            a, b = np.sum(flat**2, axis=1), flat @ offset
            inside = b**2 - a * (offset @ offset - 0.16)
            t = np.where((inside > 0) & (b > 0), (b - np.sqrt(np.maximum(inside, 0))) / a, np.inf)
            reach = np.where(t > 0, np.minimum(reach, t), reach)
        yield origin, origin + d * (reach + rng.normal(0, 0.01, returns))[:, None]
