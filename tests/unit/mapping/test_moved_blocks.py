"""Laws of the parts of a correction: moved blocks against brute force, evidence and its bytes, poses between poses."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.core.geometry import exp_so3, quaternion_from_rotation, rotation_from_quaternion
from companion.mapping.evidence import added, evidence, pack, unpack
from companion.mapping.moved_blocks import MovedBlocks
from companion.mapping.pose_track import PoseCorrector, PoseShift, PoseTrack
from companion.mapping.sensor_model import UNKNOWN, SensorModel, quantise

STEPS = quantise(SensorModel())
OCTOMAPS = quantise(SensorModel(hit=0.7, miss=0.4, lowest=0.1192, highest=0.971))
ANGLES, METRES = st.floats(-3.2, 3.2), st.floats(-5.0, 5.0)


def some_blocks(seed, number=6, reach=3):
    """Distinct positions (N, 3), and values (N, 512): unknown, free, and one in 20 occupied."""
    rng = np.random.default_rng(seed)
    xyz = np.unique(rng.integers(-reach, reach, (number, 3)), axis=0).astype(np.int32)
    values = rng.choice(np.array([UNKNOWN, -7, -2, 7, 29], np.int8), (len(xyz), 512), p=(0.4, 0.5, 0.05, 0.04, 0.01))
    return xyz, values


def cells_of(xyz, values):
    """Cell positions (K, 3) of all cells, and their values (K,)."""
    inside = np.stack(np.unravel_index(np.arange(512), (8, 8, 8)), axis=1)
    return (8 * xyz[:, None].astype(np.int64) + inside).reshape(-1, 3), values.reshape(-1)


def as_dict(xyz, values):
    cells, levels = cells_of(xyz, values)
    known = levels != UNKNOWN
    return {tuple(c): int(v) for c, v in zip(cells[known].tolist(), levels[known].tolist(), strict=True)}


def moved(xyz, values, shift):
    blocks = MovedBlocks(xyz, values, shift, 1.0)
    return as_dict(blocks.xyz, blocks.cells(0, len(blocks.xyz)))


def turn(yaw):
    return exp_so3(np.array([0.0, 0.0, yaw]))


@given(st.tuples(*[st.integers(-40, 40)] * 3), st.integers(0, 50))
@settings(max_examples=15, deadline=None)
def test_whole_cells_move_without_loss(offset, seed):
    xyz, values = some_blocks(seed)
    wanted = {tuple(np.add(c, offset).tolist()): v for c, v in as_dict(xyz, values).items()}
    assert moved(xyz, values, PoseShift(np.eye(3), np.array(offset, float))) == wanted


@pytest.mark.parametrize("quarters", [1, 2, 3])
def test_quarter_turns_lose_nothing(quarters):
    xyz, values = some_blocks(3)
    R = np.rint(turn(quarters * np.pi / 2))
    wanted = {tuple(np.floor(R @ (np.array(c) + 0.5)).astype(int).tolist()): v for c, v in as_dict(xyz, values).items()}
    assert moved(xyz, values, PoseShift(R, np.zeros(3))) == wanted


@pytest.mark.parametrize("seed", range(12))
def test_level_motions_equal_brute_force(seed):
    """Each new cell has what its centre was in, or more: an occupied cell that no centre lies in comes there."""
    xyz, values = some_blocks(seed)
    rng = np.random.default_rng(seed)
    R, t = turn(rng.normal()), rng.normal(size=3) * 5.0
    new, old = moved(xyz, values, PoseShift(R, t)), as_dict(xyz, values)
    wanted = {}
    reach = np.array([(np.array(c) + 0.5) @ R.T + t for c in old])
    low, high = np.floor(reach.min(axis=0)).astype(int) - 2, np.floor(reach.max(axis=0)).astype(int) + 3
    grid = np.stack(np.meshgrid(*[np.arange(a, b) for a, b in zip(low, high, strict=True)], indexing="ij"), axis=-1)
    grid = grid.reshape(-1, 3)
    middle = np.stack([grid[:, 0] + 0.5, grid[:, 1] + 0.5, 8 * (grid[:, 2] >> 3) + 4.0], axis=1)
    came = np.floor((middle - t) @ R - (0, 0, 3.5)).astype(int) + np.stack(
        [0 * grid[:, 2], 0 * grid[:, 2], grid[:, 2] & 7], 1
    )
    for cell, source in zip(map(tuple, grid.tolist()), map(tuple, came.tolist()), strict=True):
        if source in old:
            wanted[cell] = old[source]
    reached = set(map(tuple, came.tolist()))
    for cell, value in old.items():
        if value >= 0 and cell not in reached:
            there = tuple(np.floor(R @ (np.array(cell) + 0.5) + t).astype(int).tolist())
            wanted[there] = max(value, wanted.get(there, UNKNOWN))
    assert new == wanted


@given(st.tuples(*[st.floats(-0.05, 0.05)] * 2), ANGLES, st.tuples(METRES, METRES, METRES), st.integers(0, 50))
@settings(max_examples=40, deadline=None)
def test_every_occupied_cell_is_occupied_where_it_comes_to(tilt, yaw, t, seed):
    """Nothing solid is lost, whatever the motion; it is found within a cell of where its centre goes."""
    xyz, values = some_blocks(seed)
    R, t = turn(yaw) @ exp_so3(np.array([*tilt, 0.0])), np.array(t)
    solid = {c for c, v in moved(xyz, values, PoseShift(R, t)).items() if v >= 0}
    for cell, value in as_dict(xyz, values).items():
        if value >= 0:
            x, y, z = np.floor(R @ (np.array(cell) + 0.5) + t).astype(int).tolist()
            around = [(x + i, y + j, z + k) for i in (-1, 0, 1) for j in (-1, 0, 1) for k in (-1, 0, 1)]
            assert solid.intersection(around)


@pytest.mark.parametrize(("steps", "loss"), [(STEPS, 0), (OCTOMAPS, -OCTOMAPS.lowest / 14)])
def test_evidence_comes_back_from_bytes(steps, loss):
    rng = np.random.default_rng(1)
    values = rng.integers(-127, 128, (50, 512)).astype(np.int8)
    values[rng.random(values.shape) < 0.5] = UNKNOWN
    back = unpack(pack(values, steps), steps)
    assert np.array_equal(back == UNKNOWN, values == UNKNOWN)
    assert np.array_equal(back >= 0, values >= 0)
    assert np.abs(back.astype(int) - values).max() <= loss
    beyond = (values >= 0) | (values < steps.lowest)
    assert np.array_equal(back[beyond], values[beyond])


@given(st.lists(st.lists(st.tuples(st.booleans(), st.integers(1, 12)), max_size=4), min_size=1, max_size=6))
@settings(max_examples=150, deadline=None)
def test_evidence_of_all_stretches_adds_up_to_the_map(stretches):
    """One cell, looked at in stretches of hits (True) and misses: bit by bit as all looks at once."""
    level, total = np.full((1, 512), UNKNOWN, np.int8), np.full((1, 512), UNKNOWN, np.int8)
    clamps = (STEPS.lowest, STEPS.highest)
    for looks in stretches:
        before, bits = level.copy(), np.zeros((2, 1, 8), np.uint64)
        for hit, times in looks:
            bits[0] |= ~np.uint64(0)
            bits[1] |= ~np.uint64(0) if hit else np.uint64(0)
            for _ in range(times):
                level = added(level, np.full_like(level, STEPS.hit if hit else STEPS.miss), clamps)
        total = added(total, evidence(before, level, (bits[0], bits[1]), STEPS), clamps)
    assert np.array_equal(total, level)


def track_of(poses):
    track = PoseTrack()
    for k, (R, p) in enumerate(poses):
        track.add(10 * k, p, quaternion_from_rotation(R))
    return track


def random_poses(seed, number):
    rng = np.random.default_rng(seed)
    return [(exp_so3(rng.normal(size=3)), 10 * rng.normal(size=3)) for _ in range(number)]


def arrays_of(poses):
    return np.array([p for _, p in poses]), np.array([quaternion_from_rotation(R) for R, _ in poses])


@pytest.mark.parametrize("seed", range(5))
def test_corrected_poses_go_where_they_belong_seen_from_the_newest(seed):
    believed, corrected = random_poses(seed, 6), random_poses(seed + 100, 6)
    corrector = PoseCorrector(track_of(believed), 10 * np.arange(6), *arrays_of(corrected))
    R5, p5 = corrected[5]
    for k in range(6):
        R, p = corrector.shift_at(10 * k).of_pose(believed[k])
        seen_R, seen_p = believed[5][0].T @ R, believed[5][0].T @ (p - believed[5][1])
        assert np.allclose(seen_R, R5.T @ corrected[k][0])
        assert np.allclose(seen_p, R5.T @ (corrected[k][1] - p5))
    for newest in (50, 51, 10**6):
        assert np.allclose(corrector.shift_at(newest).R, np.eye(3))
        assert np.allclose(corrector.shift_at(newest).t, 0.0)


def test_a_motion_of_the_whole_flight_is_no_correction():
    believed = random_poses(1, 5)
    R, t = exp_so3(np.array([0.3, -0.2, 1.0])), np.array([5.0, 6.0, 7.0])
    corrector = PoseCorrector(
        track_of(believed), 10 * np.arange(5), *arrays_of([(R @ a, R @ p + t) for a, p in believed])
    )
    for stamp_ns in range(0, 45, 3):
        assert corrector.shift_at(stamp_ns).size_m(np.array([30.0, 0, 0]), 15.0) < 1e-6


def test_between_corrected_poses_the_way_bends_smoothly_and_before_them_it_is_rigid():
    poses = [(turn(0.05 * k), np.array([float(k), 0.0, 0.0])) for k in range(11)]
    p, q = arrays_of([poses[2], (poses[6][0] @ turn(0.1), poses[6][1] + (0, 0.4, 0)), poses[10]])
    corrector = PoseCorrector(track_of(poses), np.array([20, 60, 100]), p, q)
    ways = [corrector.shift_at(s).of_pose(corrector.track.at(s))[1] for s in range(20, 101)]
    assert np.linalg.norm(np.diff(ways, axis=0), axis=1).max() < 0.13
    assert np.allclose(ways[40], [6.0, 0.4, 0.0])
    first = corrector.shift_at(20)
    assert np.array_equal(corrector.shift_at(0).t, first.t)
    assert np.array_equal(corrector.shift_at(3).R, first.R)


def test_a_track_knows_its_poses_and_those_between():
    poses = [(turn(0.1 * k), np.array([float(k), 2.0 * k, 0.0])) for k in range(9000)]
    track = track_of(poses)
    assert (track.count, track.newest_ns) == (9000, 89990)
    for k in (0, 4095, 4096, 8999):
        R, p = track.at(10 * k)
        assert np.array_equal(p, poses[k][1])
        assert np.allclose(R, poses[k][0])
    R, p = track.at(41)
    assert np.allclose(p, [4.1, 8.2, 0.0])
    assert np.allclose(R, turn(0.41))
    assert np.allclose(track.at(-5)[1], 0.0)
    assert np.allclose(track.at(10**9)[1], poses[-1][1])
    assert np.allclose(rotation_from_quaternion(quaternion_from_rotation(R)), R)
