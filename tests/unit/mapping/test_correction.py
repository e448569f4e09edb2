"""Laws of corrections: what does not move stays bit by bit, what moves lands where it belongs, nothing is missed."""

import msgspec
import numpy as np
import pytest
from scipy.spatial import cKDTree

from companion.core.messages import PoseCorrections, RegisteredScan
from companion.core.rig import Rig
from companion.core.topics import CORRECTIONS, REGISTERED, WHY
from companion.mapping.correction import Correction, CorrectionConfig
from companion.mapping.deltas import delta_since
from companion.mapping.distance_field import FieldConfig
from companion.mapping.follow import FollowConfig, MapFollower
from companion.mapping.memory import MemoryConfig
from companion.mapping.mirror import MapMirror
from companion.mapping.node import MappingConfig, MappingNode
from companion.mapping.pose_track import PoseCorrector
from companion.mapping.submaps import SubmapConfig, Submaps
from companion.mapping.voxel_map import VoxelMap
from tests.unit.mapping.corridor import CONFIG, STEP_NS, TRUE, anchored, drifted, fly, quaternions, scan
from tests.unit.mapping.failing_shelf import FailingShelf

DEFAULT = CorrectionConfig()
SHORT = SubmapConfig(length_m=5.0)
DRIFTED = drifted(*TRUE, turn=0.1)
MANY = len(TRUE[0])
KEYS = np.unique(np.append(np.arange(0, MANY, 5), MANY - 1))


def flown(believed=DRIFTED, *, last=MANY, config=CONFIG, submaps=SHORT, loaded=None):
    voxels = VoxelMap.from_arrays(loaded, config) if loaded else VoxelMap(config)
    kept = Submaps(submaps, voxels)
    fly(voxels, kept, believed, range(last))
    return voxels, kept


def corrector(kept, poses=TRUE, keys=KEYS):
    return PoseCorrector(kept.track, keys * STEP_NS, poses[0][keys], quaternions(poses[1])[keys])


def corrected(voxels, kept, poses=TRUE, keys=KEYS, config=DEFAULT):
    """What was done, and in how many steps."""
    correction, steps = Correction(config, voxels, kept, corrector(kept, poses, keys)), 1
    while (done := correction.advance()) is None:
        if not kept.settled:
            kept.pack_some()
        steps += 1
    return done, steps


def same(a, b):
    first, second = a.to_arrays(), b.to_arrays()
    return all(np.array_equal(first[name], second[name]) for name in first)


def without_unknown_blocks(voxels):
    arrays = voxels.to_arrays()
    known = np.any(arrays["log_odds"] != -128, axis=1)
    return arrays["block_xyz"][known], arrays["log_odds"][known]


def classes(voxels):
    """Class bytes of each block by position."""
    arrays = voxels.to_arrays()
    kinds = np.where(arrays["log_odds"] == -128, 0, np.where(arrays["log_odds"] >= 0, 2, 1)).astype(np.uint8)
    return {tuple(xyz): kind.tobytes() for xyz, kind in zip(arrays["block_xyz"].tolist(), kinds, strict=True)}


def found(wanted, among, within_m):
    """Share of `wanted` (N, 3) that have one of `among` within a distance."""
    return float(np.mean(cKDTree(among).query(wanted)[0] <= within_m))


@pytest.fixture(scope="module")
def truth():
    """The map at the true poses, the end being where the drifted flight believes it to be."""
    voxels = VoxelMap(CONFIG)
    fly(voxels, None, anchored(*TRUE, DRIFTED[0][-1], DRIFTED[1][-1]), range(MANY))
    return voxels


def test_a_correction_that_moves_nothing_gives_the_same_bytes():
    voxels, kept = flown()
    before, version = classes(voxels), voxels.version
    arrays = voxels.to_arrays()
    done, _ = corrected(voxels, kept, DRIFTED)
    assert (done.moved, done.changed) == (0, 0)
    assert done.stayed == len(kept.closed) + 1
    assert voxels.version > version
    assert len(voxels.changed_since(version)) == 0
    assert classes(voxels) == before
    assert all(np.array_equal(arrays[name], array) for name, array in voxels.to_arrays().items())


def test_a_loop_flown_with_drift_has_double_walls_before_and_single_ones_after(truth):
    voxels, kept = flown()
    real, drifted_map = truth.occupied_centers(), voxels.occupied_centers()
    assert np.linalg.norm(DRIFTED[0][-1] - TRUE[0][-1]) > 0.009 * 86  # a hundredth of the way
    assert found(drifted_map, real, 0.21) < 0.75
    done, _ = corrected(voxels, kept)
    after = voxels.occupied_centers()
    print(f"\nprecision {found(drifted_map, real, 0.21):.3f} -> {found(after, real, 0.21):.3f}, recall "
          f"{found(real, drifted_map, 0.21):.3f} -> {found(real, after, 0.21):.3f}, "
          f"voxels {len(drifted_map)} -> {len(after)} of {len(real)}")  # fmt: skip
    assert done.moved >= 10
    assert found(after, real, 0.21) > 0.97
    assert found(real, after, 0.21) > 0.97
    assert len(after) < 1.15 * len(real) < len(drifted_map)


def test_what_the_newest_scans_saw_stays_where_it_is():
    voxels, kept = flown()
    newest = VoxelMap(CONFIG)
    fly(newest, None, DRIFTED, range(MANY - 5, MANY))
    corrected(voxels, kept)
    near = newest.occupied_centers()
    near = near[np.linalg.norm(near - DRIFTED[0][-1], axis=1) < 8.0]
    assert np.mean(voxels.classify(near) == 2) > 0.98  # older stretches see through a few


def test_work_in_small_steps_while_scans_come_in_gives_what_work_at_once_gives():
    """Scans that come during the correction are in its result."""
    keys = KEYS[KEYS < 100]
    at_once, kept = flown()
    corrected(at_once, kept, keys=keys)
    voxels, kept = flown(last=100)
    correction = Correction(CorrectionConfig(blocks_per_scan=30), voxels, kept, corrector(kept, keys=keys))

    def step(*scan):
        kept.after_scan(*scan)
        if scan[0] < (MANY - 1) * STEP_NS:
            assert correction.advance() is None

    fly(voxels, kept, DRIFTED, range(100, MANY), step)
    steps = MANY - 101
    while (done := correction.advance()) is None:
        steps += 0 if kept.settled else 1
        kept.pack_some()
    assert done.work > 60 * (MANY - 101)
    xyz, log_odds = without_unknown_blocks(voxels)
    wanted_xyz, wanted_log_odds = without_unknown_blocks(at_once)
    assert np.array_equal(xyz, wanted_xyz)
    assert np.array_equal(log_odds, wanted_log_odds)


@pytest.mark.parametrize("blocks_per_scan", [50, 400])
def test_each_step_is_bounded_and_their_size_does_not_show_in_the_map(blocks_per_scan):
    voxels, kept = flown(last=120)
    others, again = flown(last=120)
    keys = KEYS[KEYS < 120]
    done, steps = corrected(voxels, kept, keys=keys, config=CorrectionConfig(blocks_per_scan=blocks_per_scan))
    corrected(others, again, keys=keys)
    assert same(voxels, others)
    largest_stretch = max(submap.blocks for submap in kept.closed)
    assert steps >= (done.work - 8 * largest_stretch) / blocks_per_scan  # the open stretch is added in the last step


def test_insertion_takes_as_many_steps_beside_a_correction():
    voxels, kept = flown(last=100)
    alone, _ = flown(last=100)
    correction = Correction(CorrectionConfig(blocks_per_scan=30), voxels, kept, corrector(kept, keys=KEYS[KEYS < 100]))
    assert correction.advance() is None
    fly(voxels, kept, DRIFTED, range(100, 110))
    fly(alone, None, DRIFTED, range(100, 110))
    assert same(voxels, alone)  # the present map is not touched until the last step


def test_all_blocks_that_change_are_told_and_no_others():
    voxels, kept = flown()
    before, version = classes(voxels), voxels.version
    done, _ = corrected(voxels, kept)
    after = classes(voxels)
    unknown = bytes(512)
    differ = {xyz for xyz in before | after if before.get(xyz, unknown) != after.get(xyz, unknown)}
    told = {tuple(xyz) for xyz in voxels.changed_since(version).tolist()}
    assert differ <= told
    assert len(told - differ) <= 0.02 * len(told)  # blocks that are new and hold nothing known
    assert done.changed == len(told)
    assert set(before) <= set(after)  # what has gone is there, as unknown, to be told


def test_a_loaded_map_stays():
    first, _ = flown(TRUE, last=40)
    loaded = first.to_arrays()
    voxels, kept = flown(loaded=loaded)
    corrected(voxels, kept)
    rows = voxels.blocks.rows_of(loaded["block_xyz"].astype(np.int64))
    assert rows.min() >= 0
    assert voxels.blocks.held[rows].all()
    assert voxels.blocks.held.sum() == len(rows)
    untouched = VoxelMap.from_arrays(loaded, CONFIG)
    kept = Submaps(SHORT, untouched)
    kept.after_scan(0, TRUE[0][0], quaternions(TRUE[1])[0])
    corrected(untouched, kept, keys=KEYS[:1])
    assert same(untouched, VoxelMap.from_arrays(loaded, CONFIG))


def test_a_map_that_is_partly_compressed_is_corrected_alike():
    near = msgspec.structs.replace(CONFIG, max_range_m=5.0, miss_clear_range_m=4.0)
    small = msgspec.structs.replace(near, memory=MemoryConfig(keep_m=0.0, budget_mb=5.0))
    voxels, kept = flown(config=small)
    others, again = flown(config=near)
    assert voxels.memory.cold_regions > 0 == others.memory.cold_regions
    corrected(voxels, kept)
    corrected(others, again)
    assert voxels.memory.cold_regions > 0
    assert voxels.memory.forgotten_blocks == 0
    for part, wanted in zip(without_unknown_blocks(voxels), without_unknown_blocks(others), strict=True):
        assert np.array_equal(part, wanted)


def test_two_runs_give_the_same_bytes():
    runs = []
    for _ in range(2):
        voxels, kept = flown(last=80)
        corrected(voxels, kept, keys=KEYS[KEYS < 80])
        runs.append(voxels)
    assert same(*runs)


def test_a_correction_counts_from_the_flight_and_not_from_the_last_correction():
    once, kept = flown()
    corrected(once, kept)
    twice, kept = flown()
    corrected(twice, kept, drifted(*TRUE, turn=-0.03))
    while not kept.settled:
        kept.pack_some()
    corrected(twice, kept)
    xyz, log_odds = without_unknown_blocks(twice)
    wanted = without_unknown_blocks(once)
    assert np.array_equal(xyz, wanted[0])
    assert np.array_equal(log_odds, wanted[1])


def test_stretches_are_joined_when_the_budget_is_short():
    few = SubmapConfig(length_m=5.0, budget_mb=0.5)
    voxels, kept = flown(submaps=few)
    _, all_kept = flown()
    assert len(kept.closed) < len(all_kept.closed)
    assert sum(part.memory_bytes for part in kept.closed) < sum(part.memory_bytes for part in all_kept.closed)
    before = voxels.occupied_centers()
    corrected(voxels, kept, DRIFTED)
    assert found(before, voxels.occupied_centers(), 0.01) > 0.99
    assert found(voxels.occupied_centers(), before, 0.01) > 0.99


def message(poses=TRUE, keys=KEYS, **more):
    fields = {"stamps_ns": keys * STEP_NS, "p_odom": poses[0][keys], "q_odom_body": quaternions(poses[1])[keys]}
    return PoseCorrections(stamp_ns=int(keys[-1]) * STEP_NS, **(fields | more))


def followed(*words):
    """A map after corrections that come with scans 100, 102, ..., and what was done."""
    follower = MapFollower(
        FollowConfig(submaps=SHORT, correction=CorrectionConfig(blocks_per_scan=400)), VoxelMap(CONFIG)
    )
    done = []

    def after(stamp_ns, p, q):
        number = stamp_ns // STEP_NS - 100
        if number in range(0, 2 * len(words), 2):
            follower.take(words[number // 2])
        done.append(follower.after_scan(stamp_ns, p, q))

    fly(follower.voxels, follower, DRIFTED, range(MANY), after)
    assert not follower.busy
    return follower.voxels.occupied_centers(), [d for d in done if d]


def test_a_second_correction_waits_for_the_first_and_has_the_last_word():
    keys = KEYS[KEYS < 100]
    once, done = followed(message(keys=keys))
    twice, done_twice = followed(message(drifted(*TRUE, turn=-0.3), keys), message(DRIFTED, keys), message(keys=keys))
    assert (len(done), len(done_twice)) == (1, 2)
    assert found(once, twice, 0.21) > 0.99
    assert found(twice, once, 0.21) > 0.99


def test_mirrors_follow_corrections_that_run_beside_scans():
    """All that differs after the last step is told, in pieces, be it seen before, during or after the comparison."""
    correction = CorrectionConfig(blocks_per_scan=300)
    follower = MapFollower(FollowConfig(submaps=SHORT, correction=correction), VoxelMap(CONFIG))
    voxels, mirror, done, known = follower.voxels, MapMirror(), [], [0]

    def tell():
        delta = delta_since(voxels, known[0], stamp_ns=0, map_ns=0, most=300)
        if delta is not None:
            known[0] = delta.version_to
            assert mirror.take(delta)

    def after(stamp_ns, p, q):
        if stamp_ns in (60 * STEP_NS, 100 * STEP_NS):
            follower.take(message(keys=KEYS[stamp_ns // STEP_NS > KEYS]))
        done.append(follower.after_scan(stamp_ns, p, q))
        tell()

    fly(voxels, follower, DRIFTED, range(MANY), after)
    while known[0] < voxels.version:
        tell()
    assert [d.changed > 600 for d in done if d] == [True, True]
    ours, theirs = classes(voxels), classes(mirror.voxels)
    assert {xyz: kind for xyz, kind in ours.items() if any(kind)} == {x: k for x, k in theirs.items() if any(k)}


def follow_with(shelf):
    voxels = VoxelMap(CONFIG, shelf=shelf)
    follower = MapFollower(FollowConfig(submaps=SHORT), voxels)

    def after(stamp_ns, p, q):
        if stamp_ns == 100 * STEP_NS:
            follower.take(message(keys=KEYS[KEYS < 100]))
        follower.after_scan(stamp_ns, p, q)

    fly(voxels, follower, DRIFTED, range(MANY), after)
    return follower


def test_stretches_on_a_shelf_give_the_same_map_and_take_no_memory():
    inside, shelf = follow_with(None), FailingShelf()
    outside = follow_with(shelf)
    assert same(inside.voxels, outside.voxels)
    assert inside.submaps.shelves.inside_bytes == outside.submaps.shelves.outside_bytes > 0
    saved = inside.submaps.memory_bytes - outside.submaps.memory_bytes
    assert saved == outside.submaps.shelves.outside_bytes
    assert inside.failure is None is outside.failure


def test_a_stretch_that_cannot_be_read_ends_corrections_and_leaves_the_map_alone():
    uncorrected, _ = flown()
    follower = follow_with(FailingShelf(breaks=0))
    assert "Input/output error" in follower.failure
    assert not follower.busy
    assert same(follower.voxels, uncorrected)
    follower.take(message())
    assert follower.skipped == 1


@pytest.mark.parametrize(
    "change",
    [
        {"stamps_ns": np.array([3, 2]), "p_odom": np.zeros((2, 3)), "q_odom_body": np.tile([1.0, 0, 0, 0], (2, 1))},
        {"p_odom": np.full((len(KEYS), 3), np.nan)},
        {"q_odom_body": np.zeros((len(KEYS), 4))},
        {"p_odom": np.zeros((2, 3))},
        {"stamps_ns": np.empty(0, np.int64), "p_odom": np.empty((0, 3)), "q_odom_body": np.empty((0, 4))},
    ],
)
def test_what_is_no_correction_is_counted_and_left_out(change):
    voxels = VoxelMap(CONFIG)
    follower = MapFollower(FollowConfig(submaps=SHORT), voxels)
    follower.take(message())  # before the first scan
    fly(voxels, follower, DRIFTED, range(3), follower.after_scan)
    follower.take(message(**change))
    assert (follower.skipped, follower.busy) == (2, False)


def test_small_corrections_are_no_work():
    voxels = VoxelMap(CONFIG)
    follower = MapFollower(FollowConfig(submaps=SHORT), voxels)
    fly(voxels, follower, DRIFTED, range(60), follower.after_scan)
    nudged = (DRIFTED[0] + np.linspace(0.05, 0, MANY)[:, None] * (1, 0, 0), DRIFTED[1])
    follower.take(message(nudged, KEYS[KEYS < 60]))
    assert follower.after_scan(60 * STEP_NS, DRIFTED[0][60], quaternions(DRIFTED[1])[60]) is None
    assert not follower.busy


def test_the_node_follows_and_says_so():
    config = MappingConfig(
        voxels=CONFIG,
        field=FieldConfig(size_m=(8.0, 8.0, 6.0)),
        follow=FollowConfig(submaps=SHORT, correction=CorrectionConfig(blocks_per_scan=4000)),
    )
    node, quaternion = MappingNode(config, Rig(), hull_radius_m=0.35), quaternions(DRIFTED[1])
    keys, said = KEYS[KEYS < 40], []
    for k in range(60):
        returns, misses = scan(k)
        registered = RegisteredScan(
            stamp_ns=k * STEP_NS,
            points_body=returns,
            miss_dirs_body=misses,
            origin_body=np.zeros(3),
            p_odom=DRIFTED[0][k],
            q_odom_body=quaternion[k],
        )
        if k == 40:
            assert list(node.handle(CORRECTIONS, message(keys=keys))) == []
        said += [(k, o.message.what) for o in node.handle(REGISTERED, registered) if o.topic is WHY]
    assert len(said) == 1
    assert said[0][0] > 41
    assert said[0][1].startswith("corrected the map: ")
    assert not node.follower.busy
