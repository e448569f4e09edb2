"""The frontier that is kept up to date equals that of the whole map, voxel by voxel."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.mapping.frontiers import Frontiers
from companion.mapping.voxel_map import VoxelMap, VoxelMapConfig

SIDES = np.array([[-1, 0, 0], [1, 0, 0], [0, -1, 0], [0, 1, 0], [0, 0, -1], [0, 0, 1]])


def brute_force(voxels):
    """Every free voxel with an unknown one across a face, by asking the map for each."""
    count = voxels.blocks.count
    row, cell = np.nonzero((voxels.blocks.log_odds[:count] < 0) & (voxels.blocks.log_odds[:count] != -128))
    cells = 8 * voxels.blocks.xyz[row].astype(np.int64) + np.stack([cell >> 6, cell >> 3 & 7, cell & 7], axis=1)
    beside = (cells[:, None] + SIDES).reshape(-1, 3)
    unknown = voxels.classify((beside + 0.5) * voxels.resolution_m).reshape(-1, 6) == 0
    return cells[unknown.any(axis=1)]


def as_set(cells):
    return set(map(tuple, cells.tolist()))


def look(voxels, rng):
    origin = rng.uniform(-2, 2, 3)
    points = rng.normal(size=(int(rng.integers(1, 30)), 3)).astype(np.float32) * 3
    voxels.insert(points, R_odom_body=np.eye(3), p_odom=origin, origin_odom=origin)


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 10_000), skip=st.floats(0, 0.8))
def test_the_frontier_equals_brute_force_over_the_whole_map_after_any_updates(seed, skip):
    rng = np.random.default_rng(seed)
    voxels, frontiers = VoxelMap(VoxelMapConfig(max_range_m=2.5, miss_clear_range_m=2.5)), Frontiers()
    for _ in range(6):
        look(voxels, rng)
        if rng.random() < 0.3:  # decay or a correction takes knowledge back
            rows = rng.permutation(voxels.block_count)[:3]
            cells = voxels.blocks.log_odds[rows]
            cells[rng.random(cells.shape) < rng.choice([0.2, 1.0])] = -128
            voxels.blocks.write(rows, cells, voxels.steps.lowest)
        if rng.random() < skip:
            continue
        before = as_set(frontiers.cells())
        changed = frontiers.update(voxels)
        expected = brute_force(voxels)
        found = frontiers.cells()
        assert as_set(found) == as_set(expected) and len(frontiers) == len(found) == len(expected)
        moved = {tuple(c >> 3 for c in cell) for cell in before ^ as_set(found)}
        assert moved == as_set(changed)
        assert as_set(frontiers.cells(changed)) == {c for c in as_set(found) if tuple(x >> 3 for x in c) in moved}


def test_the_order_of_updates_does_not_show():
    voxels, often, once = VoxelMap(VoxelMapConfig(max_range_m=2.5, miss_clear_range_m=2.5)), Frontiers(), Frontiers()
    rng = np.random.default_rng(2)
    for _ in range(6):
        look(voxels, rng)
        often.update(voxels)
    once.update(voxels)
    assert often.cells().tobytes() == once.cells().tobytes()
    assert len(often.update(voxels)) == 0


def test_every_free_cell_of_a_lone_block_at_its_rim_is_frontier():
    voxels = VoxelMap(VoxelMapConfig())
    voxels.blocks.add(np.array([[-1, 4, 0]], np.int32), np.full((1, 512), -3, np.int8), -7, held=False)
    frontiers = Frontiers()
    assert frontiers.update(voxels).tolist() == [[-1, 4, 0]]
    assert len(frontiers) == 8**3 - 6**3
    np.testing.assert_allclose(frontiers.centers(0.2), (frontiers.cells() + 0.5) * 0.2)


def test_an_empty_map_has_none():
    frontiers = Frontiers()
    assert len(frontiers.update(VoxelMap(VoxelMapConfig()))) == 0
    assert frontiers.cells().shape == (0, 3) and len(frontiers) == 0
