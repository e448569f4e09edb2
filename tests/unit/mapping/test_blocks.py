"""Laws of the block store: what is added is found, what is removed is gone, and versions count changes."""

import numpy as np
import pytest

from companion.mapping.block_hash import EMPTY, _home, _tries
from companion.mapping.blocks import BlockStore
from companion.mapping.rays import CELLS
from companion.mapping.sensor_model import UNKNOWN
from companion.mapping.voxel_map import VoxelMap, VoxelMapConfig

LOWEST = -7


def random_blocks(rng, number, spread=60):
    """Distinct positions (N, 3) and log-odds (N, 512)."""
    xyz = np.unique(rng.integers(-spread, spread, (2 * number, 3)), axis=0)
    xyz = rng.permutation(xyz)[:number].astype(np.int32)
    return xyz, rng.integers(LOWEST, 30, (len(xyz), CELLS)).astype(np.int8)


def held_in(store):
    """What the store says, by position."""
    rows = range(store.count)
    return {tuple(store.xyz[r].tolist()): (store.log_odds[r].tobytes(), int(store.held[r])) for r in rows}


@pytest.mark.parametrize("shape", [(32, 32, 32), (180, 180, 1), (3, 3, 3600), (1, 1, 32_000)])
def test_blocks_side_by_side_are_found_after_few_tries(shape):
    """The last is a line: four neighbours share sixteen slots, so a quarter of the slots takes all."""
    store = BlockStore()
    xyz = np.stack(np.unravel_index(np.arange(np.prod(shape)), shape), axis=1).astype(np.int32) - 1000
    store.add(xyz, np.zeros((len(xyz), CELLS), np.int8), LOWEST, held=False)
    keys, rows = store.table
    slots = np.flatnonzero(keys != EMPTY)
    homes = np.array([_home(len(keys) - 1, *store.xyz[row].tolist()) for row in rows[slots]])
    tries = [_tries(int(apart), len(keys) - 1) for apart in slots - homes]
    assert np.mean(tries) < 2.5
    assert np.array_equal(store.rows_of(xyz), np.arange(len(xyz)))
    assert not np.any(store.rows_of(xyz + np.array([0, 40_000, 0])) >= 0)


@pytest.mark.parametrize("seed", range(5))
def test_random_adds_and_removes_match_a_dictionary(seed):
    rng = np.random.default_rng(seed)
    store, reference = BlockStore(), {}
    xyz, log_odds = random_blocks(rng, 12_000)
    for first in range(0, len(xyz), 3000):
        held = bool(rng.integers(2))
        part = slice(first, first + 3000)
        store.add(xyz[part], log_odds[part], LOWEST, held)
        reference.update(
            {tuple(p.tolist()): (b.tobytes(), int(held)) for p, b in zip(xyz[part], log_odds[part], strict=True)}
        )
        gone = rng.permutation(store.count)[: store.count // int(rng.integers(2, 9))]
        for row in gone:
            del reference[tuple(store.xyz[row].tolist())]
        store.remove(gone)
        assert held_in(store) == reference
    rows = store.rows_of(xyz.astype(np.int64))
    assert [int(r) >= 0 for r in rows] == [tuple(p.tolist()) in reference for p in xyz]
    assert np.array_equal(store.xyz[rows[rows >= 0]], xyz[rows >= 0])


def test_removing_all_blocks_gives_the_memory_back():
    store = BlockStore()
    empty = store.memory_bytes
    xyz, log_odds = random_blocks(np.random.default_rng(1), 20_000)
    store.add(xyz, log_odds, LOWEST, False)
    full = store.memory_bytes
    store.remove(np.arange(store.count))
    assert full > empty + CELLS * 15_000
    assert store.memory_bytes < empty + 2e6  # the hash keeps its size


def test_a_row_used_again_is_blank():
    store = BlockStore()
    xyz, log_odds = random_blocks(np.random.default_rng(1), 10)
    store.add(xyz, log_odds, LOWEST, True)
    store.remove(np.arange(10))
    store.add(xyz[:1], np.full((1, CELLS), UNKNOWN, np.int8), LOWEST, False)
    assert (store.held[0], store.seen_ns[0], store.changed_at[0]) == (0, 0, store.version)


def test_changed_since_names_the_blocks_of_later_scans_only():
    voxels = VoxelMap(VoxelMapConfig(max_range_m=8.0, miss_clear_range_m=5.0))
    turn, origin = np.eye(3), np.array([0.3, 0.3, 0.3])
    voxels.insert(np.array([[5.0, 0, 0]], np.float32), R_odom_body=turn, p_odom=origin, origin_odom=origin)
    version = voxels.version
    assert len(voxels.changed_since(version)) == 0
    delta = voxels.insert(
        np.array([[0, 5.0, 0]], np.float32), R_odom_body=turn, p_odom=origin, origin_odom=origin, stamp_ns=70
    )
    changed = voxels.changed_since(version)
    assert np.array_equal(np.sort(changed, axis=0), np.sort(delta.changed_blocks, axis=0))
    assert set(changed[:, 1].tolist()) == {0, 1, 2, 3}
    seen = voxels.blocks.seen_ns[voxels.blocks.rows_of(changed.astype(np.int64))]
    assert seen.tolist() == [70] * len(changed)
