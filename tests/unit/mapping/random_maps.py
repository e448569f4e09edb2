"""Maps for tests of the formats: blocks of all kinds, also eight equal ones that make a coarser leaf."""

import numpy as np

from companion.mapping.formats.stored_map import StoredMap
from companion.mapping.sensor_model import UNKNOWN, SensorModel, quantise

OURS = SensorModel()
OCTOMAPS = SensorModel(hit=0.7, miss=0.4, lowest=0.1192, highest=0.971)


def random_map(seed: int, blocks: int = 12, sensor: SensorModel = OURS, resolution_m: float = 0.2) -> StoredMap:
    rng = np.random.default_rng(seed)
    steps = quantise(sensor)
    xyz = rng.integers(-3, 3, (blocks, 3))
    cube = 2 * rng.integers(-2, 2, 3) + np.indices((2, 2, 2)).reshape(3, -1).T
    places = np.unique(np.concatenate([xyz, cube]), axis=0)
    cells = rng.integers(steps.lowest, steps.highest + 1, (len(places), 512))
    cells[rng.random(cells.shape) < rng.uniform(0.0, 1.0)] = UNKNOWN
    for block, kind in enumerate(rng.integers(0, 3, len(places))):
        if kind == 0:
            cells[block] = rng.choice([steps.lowest, steps.highest])
        if kind == 1:
            cells[block, : 8 * rng.integers(1, 64)] = -1
    cells[np.any(np.all(places[:, None] == cube, axis=2), axis=1)] = steps.lowest
    shuffled = rng.permutation(len(places))
    log_odds = cells.astype(np.int8)[shuffled]
    return StoredMap(resolution_m, sensor, places.astype(np.int32)[shuffled], log_odds)


def same(one: StoredMap, other: StoredMap) -> bool:
    a, b = one.canonical(), other.canonical()
    return np.array_equal(a.block_xyz, b.block_xyz) and np.array_equal(a.log_odds, b.log_odds)


def classes(stored: StoredMap) -> StoredMap:
    """The same map, its voxels at the clamps."""
    steps = quantise(stored.sensor)
    clamped = np.where(stored.log_odds >= 0, steps.highest, steps.lowest)
    values = np.where(stored.log_odds == UNKNOWN, UNKNOWN, clamped).astype(np.int8)
    return StoredMap(stored.resolution_m, stored.sensor, stored.block_xyz, values)
