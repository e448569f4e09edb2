"""Decay: what has left goes, seen or not; what stays, stays; a loaded map is not erased."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.core.errors import InputError
from companion.core.messages import ObstacleTracks
from companion.core.rig import Rig
from companion.mapping.decay import Decay, DecayConfig, decay
from companion.mapping.voxel_map import VoxelMap, VoxelMapConfig
from companion.mapping.walked import walked_cells
from sim.sensors.caster import Caster
from sim.sensors.lidar import Lidar, LidarConfig
from sim.world import load_world

MAP = VoxelMapConfig(max_range_m=12.0, miss_clear_range_m=6.0)
SCAN_NS = 100_000_000
BOX = np.stack(np.meshgrid([4.1, 4.3, 4.5], [-0.1, 0.1, 0.3], [0.1, 0.3, 0.5, 0.7], indexing="ij"), -1).reshape(-1, 3)
FRONT = BOX[np.isclose(BOX[:, 0], 4.1)]
WALL = np.stack(np.meshgrid([8.1], np.arange(-1.1, 1.3, 0.07), np.arange(-1.1, 2.3, 0.07), indexing="ij"), -1)
WALL = WALL.reshape(-1, 3)
FEW = DecayConfig(crowd=4)  # the walls and figures of these tests are small


class Mapper:
    """Scans at 10 Hz from the origin, with decay."""

    def __init__(self, config=None, voxels=None):
        self.voxels = voxels or VoxelMap(MAP, decays=True)
        self.decay, self.now_ns = Decay(config or FEW), 0

    def see(self, points, times=1):
        for _ in range(times):
            self.now_ns += SCAN_NS
            vectors = np.asarray(points, np.float32).reshape(-1, 3)
            zero = np.zeros(3)
            self.voxels.insert(vectors, R_odom_body=np.eye(3), p_odom=zero, origin_odom=zero, stamp_ns=self.now_ns)
            self.decay.after_scan(self.voxels, self.now_ns)
        return self

    def classes(self, points):
        return sorted(set(self.voxels.classify(np.asarray(points)).tolist()))


def test_a_ghost_that_nobody_looks_at_any_more_is_forgotten_within_two_seconds():
    """A thing came into seen free space, left, and its place fell out of view: it is unknown, not occupied."""
    m = Mapper().see(WALL, 12)
    assert m.classes(FRONT) == [1]
    m.see(FRONT, 8)
    assert m.classes(FRONT) == [2]
    m.see([[-5.0, 0.0, 0.0]], 20)
    assert m.classes(FRONT) == [0]
    assert m.classes(WALL) == [2]


def test_a_ghost_in_view_is_free_within_two_seconds_at_any_phase_of_the_passes():
    for phase in range(5):
        m = Mapper().see(WALL, 12 + phase).see(FRONT, 8).see(WALL, 20)
        assert m.classes(FRONT) == [1]


def test_what_was_there_from_the_beginning_is_cleared_by_looks_only():
    m = Mapper().see(np.vstack([FRONT, WALL]), 30)
    m.see([[-5.0, 0.0, 0.0]], 600)
    assert m.classes(FRONT) == [2]
    m.see(WALL, 20)
    assert m.classes(FRONT) == [1]
    off = Mapper(DecayConfig(on=False)).see(np.vstack([FRONT, WALL]), 30).see(WALL, 20)
    assert off.classes(FRONT) == [2]


def test_a_branch_that_one_scan_in_four_meets_stays_for_ever():
    """Even where it is found late, at the lower clamp: it is forgotten once at most."""
    rng = np.random.default_rng(1)
    branch = np.array([[3.1, 0.1 + 0.2 * k, 0.1] for k in range(5)])
    beyond = branch * 3
    m = Mapper().see(beyond, 15)
    seen = []
    for k in range(600):
        met = rng.random(len(branch)) < 0.25
        m.see(np.where(met[:, None], branch, beyond))
        if k > 100:
            seen.append(np.mean(m.voxels.classify(branch) == 2))
    assert np.mean(seen) > 0.97


def test_a_twig_that_one_scan_in_sixteen_meets_stays_once_it_is_proven():
    """One return outweighs eleven scans without: if all counted, it would be gone half of the time (0.50)."""
    rng = np.random.default_rng(2)
    twig = np.array([[3.1, 0.1 + 0.2 * k, 0.1] for k in range(5)])
    beyond = twig * 3
    m = Mapper().see(beyond, 15)
    for met in (True, False, True):
        m.see(twig if met else [[-5.0, 0.0, 0.0]], 5 if met else 14)
    seen = []
    for _ in range(600):
        met = rng.random(len(twig)) < 1 / 16
        m.see(np.where(met[:, None], twig, beyond))
        seen.append(np.mean(m.voxels.classify(twig) == 2))
    assert np.mean(seen) > 0.85


def test_what_was_proven_and_leaves_is_free_within_twelve_seconds():
    """The clamps bound it: 29 misses, of which one in four scans counts."""
    for phase in range(4):
        m = Mapper().see(np.vstack([FRONT, WALL]), 10 + phase)
        m.see([[-5.0, 0.0, 0.0]], 14).see(FRONT, 30)
        assert m.see(WALL, 30).classes(FRONT) == [2]
        assert m.see(WALL, 90).classes(FRONT) == [1]


def test_few_cells_do_not_decay_and_many_do():
    for cells, state in ((3, 2), (4, 0)):
        m = Mapper().see(WALL, 12).see(FRONT[:cells], 8).see([[-5.0, 0.0, 0.0]], 30)
        assert m.classes(FRONT[:cells]) == [state]


def walks_at(x, y, *, speed=1.0, stamp_ns=0):
    one = np.ones(1)
    return ObstacleTracks(
        stamp_ns=stamp_ns, id=np.zeros(1, np.int64), position_odom=np.array([[x, y, 0.5]]),
        velocity_odom=np.array([[speed, 0.0, 0.0]]), position_variance=one, velocity_variance=one,
        cross_covariance=one, radius_m=np.array([0.3]),
    )  # fmt: skip


@pytest.mark.parametrize(("track", "state"), [((4.1, 0.1), 0), ((4.1, 2.0), 2), (None, 2)])
def test_where_something_moved_no_crowd_is_needed(track, state):
    m = Mapper().see(WALL, 12).see(FRONT[:1], 8)
    if track:
        m.decay.take(walks_at(*track, stamp_ns=m.now_ns))
    m.see([[-5.0, 0.0, 0.0]], 30)
    assert m.classes(FRONT[:1]) == [state]


@pytest.mark.parametrize(
    ("now_at", "variance", "state"), [(9.0, 0.01, 1), (4.6, 0.01, 0), (9.0, 4.0, 0), (None, 0.01, 0)]
)
def test_what_is_tracked_elsewhere_by_now_leaves_free_space_and_what_is_lost_leaves_unknown(now_at, variance, state):
    """Before it came the space was free. A track that may still be there, or is told no more, does not count."""
    m = Mapper().see(WALL, 12).see(FRONT[:1], 8)
    m.decay.take(walks_at(4.1, 0.1, stamp_ns=m.now_ns))
    for _ in range(20):
        if now_at is not None:
            elsewhere = walks_at(now_at, 0.1, stamp_ns=m.now_ns)
            m.decay.take(replace(elsewhere, position_variance=np.full(1, variance)))
        m.see([[-5.0, 0.0, 0.0]])
    assert m.classes(FRONT[:1]) == [state]


@pytest.mark.parametrize(("speed", "late_ns"), [(0.2, 0), (1.0, -4_000_000_000)])
def test_what_hardly_moves_or_moved_long_ago_leaves_no_ghosts(speed, late_ns):
    m = Mapper().see(WALL, 12).see(FRONT[:1], 8)
    m.decay.take(walks_at(4.1, 0.1, speed=speed, stamp_ns=m.now_ns + late_ns))
    m.see([[-5.0, 0.0, 0.0]], 30)
    assert m.classes(FRONT[:1]) == [2]


def test_a_slow_walker_hit_twice_in_a_cell_does_not_become_part_of_the_forest():
    """Without a track it is proven, and 16 cells of it stay: with one it goes. What was proven before stays."""
    away = [[-5.0, 0.0, 0.0]]
    for walks, state in ((False, 2), (True, 0)):
        m = Mapper().see(WALL, 12)
        for seen, times in ((FRONT, 8), (away, 11), (FRONT, 8), (away, 15), (away, 15)):
            if walks:
                m.decay.take(walks_at(4.1, 0.1, stamp_ns=m.now_ns))
            m.see(seen, times)
        assert m.classes(FRONT) == [state]
    m = Mapper().see(WALL, 12).see(FRONT, 8).see(away, 11).see(FRONT, 8)
    for _ in range(3):
        m.decay.take(walks_at(4.1, 0.1, stamp_ns=m.now_ns))
        m.see(away, 10)
    assert m.classes(FRONT) == [2]


def test_what_was_there_from_the_beginning_stays_though_something_walks_beside_it():
    m = Mapper().see(np.vstack([FRONT, WALL]), 30)
    m.decay.take(walks_at(4.1, 0.1, stamp_ns=m.now_ns))
    m.see([[-5.0, 0.0, 0.0]], 30)
    assert m.classes(FRONT) == [2]


@given(seed=st.integers(0, 2**32 - 1))
@settings(max_examples=50, deadline=None)
def test_cells_in_cylinders_are_those_whose_middle_is(seed):
    rng = np.random.default_rng(seed)
    blocks = rng.integers(-3, 3, (4, 3)).astype(np.int32)
    middle, radius, low = rng.uniform(-20, 20, (3, 2)), rng.uniform(0.2, 9.0, 3), rng.uniform(-20, 10, 3)
    cylinders = np.column_stack([middle, radius**2, low, low + rng.uniform(0.1, 20.0, 3)])
    cell = np.stack(np.meshgrid(*[np.arange(8)] * 3, indexing="ij"), -1).reshape(-1, 3) + 0.5
    at = 8.0 * blocks[:, None] + cell
    away2 = np.sum((at[:, :, None, :2] - middle) ** 2, axis=-1)
    z = at[:, :, 2, None]
    inside = np.any((away2 <= radius**2) & (z >= cylinders[:, 3]) & (z <= cylinders[:, 4]), axis=2)
    bits = walked_cells(blocks, cylinders)
    np.testing.assert_array_equal(np.unpackbits(bits.view(np.uint8), axis=1, bitorder="little"), inside)


def test_a_loaded_map_loses_newcomers_only():
    made = Mapper(DecayConfig(on=False)).see(WALL, 40).voxels
    made.blocks.held[: made.blocks.count] = 1
    m = Mapper(voxels=VoxelMap.from_arrays(made.to_arrays(), MAP, decays=True))
    assert np.all(m.voxels.blocks.held[: m.voxels.blocks.count] == 1)
    m.see(FRONT, 8)
    assert m.classes(FRONT) == [2]
    m.see([[-5.0, 0.0, 0.0]], 30)
    assert m.classes(FRONT) == [1]
    m.see([[-5.0, 0.0, 0.0]], 300)
    assert m.classes(WALL) == [2]


@pytest.mark.parametrize(("held", "erase", "state"), [(0, False, 0), (1, False, 2), (1, True, 0)])
def test_unseen_blocks_go_if_asked_and_loaded_ones_only_if_asked_for_too(held, erase, state):
    m = Mapper(DecayConfig(forget_unseen_s=5.0, erase_loaded=erase)).see(WALL, 40)
    m.voxels.blocks.held[: m.voxels.blocks.count] = held
    m.see([[-5.0, 0.0, 0.0]], 40)
    assert m.classes(WALL) == [2]
    m.see([[-5.0, 0.0, 0.0]], 20)
    assert m.classes(WALL) == [state]
    assert m.classes([[-4.0, 0.0, 0.0]]) == [1]


def test_a_pass_names_the_blocks_that_changed_and_no_others():
    m = Mapper(DecayConfig(on=False)).see(WALL, 12).see(FRONT, 8)
    config, version = FEW, m.voxels.version
    changed = [decay(m.voxels, m.now_ns, config, since_ns=0) for _ in range(6)]
    named = {tuple(b) for b in np.concatenate(changed).tolist()}
    assert named == {tuple(b) for b in np.floor(FRONT / 1.6).astype(int).tolist()}
    assert {tuple(b) for b in m.voxels.changed_since(version).tolist()} == named


def test_a_map_without_marks_is_refused():
    with pytest.raises(InputError, match="decays=True"):
        decay(VoxelMap(MAP), 0, DecayConfig(), since_ns=0)


def test_blocks_that_move_or_return_keep_their_marks():
    m = Mapper(DecayConfig(on=False)).see(WALL, 12).see(FRONT, 8)
    blocks = m.voxels.blocks
    row = blocks.rows_of(np.floor(FRONT[:1] / 1.6).astype(np.int64))
    before = blocks.take(row)
    assert before["marks"].any()
    first = np.append(np.setdiff1d(np.arange(3), row), blocks.rows_of(np.floor(WALL[:1] / 1.6).astype(np.int64)))
    kept = blocks.take(first)
    assert kept["marks"].any()
    blocks.remove(first)
    blocks.put(kept, m.voxels.steps.lowest)
    for wanted in (before, kept):
        again = blocks.take(blocks.rows_of(wanted["xyz"].astype(np.int64)))
        for name, array in wanted.items():
            np.testing.assert_array_equal(again[name], array, err_msg=name)


def test_ghosts_of_a_rendered_walker_are_gone_within_two_seconds():
    """A walker crosses a meadow before a hovering LiDAR: of the cells it leaves within 9 m, each
    that the map takes for occupied is not so any more 2 s later, but for one in a hundred where
    a crowd of four is enough, and one in fifty as shipped."""
    world = load_world(
        "empty", seed=2, options={"walker_paths": [[[6, -7], [6, 7]]], "walker_speed_m_s": [1.2, 1.2],
                                  "walker_height_m": 2.8, "walker_radius_m": 0.35},
    )  # fmt: skip
    sharp, shipped, off = (ghost_lives(world, c) for c in (FEW, DecayConfig(), DecayConfig(on=False)))
    assert len(sharp) > 500
    assert np.mean(sharp > 2.0) < 0.01
    assert np.mean(shipped > 2.0) < 0.02
    assert np.mean(off > 2.0) > 0.4


def ghost_lives(world, config):
    """How long cells stay occupied after the walker has left them, s, in 15 s of scans."""
    rig, voxels, decay_ = Rig(), VoxelMap(VoxelMapConfig(max_range_m=15.0), decays=True), Decay(config)
    lidar = Lidar(LidarConfig(), rig.lidar, Caster(world.mesh), world.mesh, 0, walkers=world.walkers)
    R, p = rig.lidar.R_body_sensor, np.array([0.0, 0.0, 2.0])
    poses = np.tile(p, (2, 1)), np.tile([1.0, 0.0, 0.0, 0.0], (2, 1))
    edges = [np.arange(a, b, 0.2) + 0.1 for a, b in ((5.2, 6.8), (-8.0, 8.0), (0.4, 2.8))]
    cells = np.stack(np.meshgrid(*edges, indexing="ij"), -1).reshape(-1, 3)
    left_s, lives = np.full(len(cells), np.nan), []
    for k in range(1, 151):
        stamp = k * SCAN_NS
        scan = lidar.scan(*poses, stamp_ns=stamp, counter=k)
        points, misses = ((v @ R.T).astype(np.float32) for v in (scan.points_sensor, scan.miss_dirs_sensor))
        origin = p + rig.lidar.p_body
        voxels.insert(
            points + rig.lidar.p_body.astype(np.float32), R_odom_body=np.eye(3), p_odom=p, origin_odom=origin,
            miss_dirs_body=misses, stamp_ns=stamp,
        )  # fmt: skip
        decay_.after_scan(voxels, stamp)
        feet = np.array([world.walkers.feet(stamp - age)[0] for age in (0, SCAN_NS // 2, SCAN_NS)])
        inside = np.any(np.hypot(cells[:, None, 0] - feet[:, 0], cells[:, None, 1] - feet[:, 1]) < 0.55, axis=1)
        occupied = voxels.classify(cells) == 2
        ghosts = ~np.isnan(left_s)
        gone = ghosts & ~occupied & ~inside
        lives += (0.1 * k - left_s[gone]).tolist()
        left_s[gone | inside] = np.nan
        left_s[inside & occupied] = 0.1 * k
        left_s[inside & ~occupied] = np.nan
    lives += (15.0 - left_s[~np.isnan(left_s) & (left_s < 13.0)]).tolist()
    return np.array(lives)
