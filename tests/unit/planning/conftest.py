"""Worlds for the planners: local maps made from exact occupancy."""

import importlib.util
from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import distance_transform_edt

from companion.core.messages import LocalMap, freeze

RESOLUTION_M = 0.2


def _local_map(occupied, *, known=None, origin=(0.0, 0.0, 0.0), ground_z=np.nan, stamp_ns=0, resolution_m=RESOLUTION_M):
    """`occupied`, `known` (X, Y, Z) bool -> the message that mapping would send."""
    known = np.ones(occupied.shape, bool) if known is None else known
    state = np.where(known, np.where(occupied, 2, 1), 0).astype(np.uint8)

    def field(mask):
        if not mask.any():
            return np.full(mask.shape, 2.0, np.float32)
        gap = (distance_transform_edt(~mask) - 0.5) * resolution_m
        return np.clip(gap, 0.0, 2.0).astype(np.float32)

    distance = field(state == 2)
    message = LocalMap(
        stamp_ns=stamp_ns,
        origin_odom=np.array(origin, float),
        resolution_m=resolution_m,
        state=state,
        distance_m=distance,
        unknown_distance_m=distance if known.all() else field(state != 1),
        ground_z_odom=np.full(occupied.shape[:2], ground_z, np.float32),
    )
    return freeze(message)


def _forest(rng, *, size_m=(40.0, 40.0, 8.0), stems_per_ha=400.0, keep_clear=(), branches=True):
    """Trunks with a few branches above a flat ground at z = 0 (the lowest cell)."""
    shape = tuple(round(s / RESOLUTION_M) for s in size_m)
    occupied = np.zeros(shape, bool)
    occupied[:, :, 0] = True
    axes = [(np.arange(n) + 0.5) * RESOLUTION_M for n in shape]
    x, y = np.meshgrid(axes[0], axes[1], indexing="ij")
    for _ in range(rng.poisson(stems_per_ha * size_m[0] * size_m[1] / 1e4)):
        cx, cy, r = rng.uniform(0, size_m[0]), rng.uniform(0, size_m[1]), rng.uniform(0.1, 0.25)
        turns, heights, reaches = rng.uniform(0, 2 * np.pi, 3), rng.uniform(1.0, 5.0, 3), rng.uniform(0.5, 1.5, 3)
        if any(np.hypot(cx - px, cy - py) < 2.0 for px, py in keep_clear):
            continue
        occupied |= ((x - cx) ** 2 + (y - cy) ** 2 <= (r + 0.1) ** 2)[:, :, None]
        for turn, height, reach in zip(turns, heights, reaches, strict=True):
            for t in np.arange(0.0, reach if branches else 0.0, 0.1):
                cell = np.array([cx + t * np.cos(turn), cy + t * np.sin(turn), height + 0.3 * t]) / RESOLUTION_M
                if np.all(cell >= 0) and np.all(cell < shape):
                    occupied[tuple(cell.astype(int))] = True
    return occupied


@pytest.fixture(scope="session")
def local_map():
    return _local_map


@pytest.fixture(scope="session")
def forest():
    return _forest


@pytest.fixture(scope="session")
def flights():
    path = Path(__file__).with_name("flights.py")
    spec = importlib.util.spec_from_file_location("planning_flights", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module
