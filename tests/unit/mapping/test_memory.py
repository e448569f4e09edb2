"""Laws of eviction: a map that puts far blocks away is the map that does not, bit by bit."""

import hashlib

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.mapping.blocks import BlockStore
from companion.mapping.cell_coder import decode, encode
from companion.mapping.cold_region import (
    all_blocks,
    in_region_order,
    keys_of,
    pack,
    places_of,
    positions_of,
    region_key,
    regions_of,
    unpack,
)
from companion.mapping.decay import Decay, DecayConfig
from companion.mapping.deltas import FullWalk, delta_since, records_of, states_of
from companion.mapping.deltas import unpack as records_from
from companion.mapping.memory import MemoryConfig
from companion.mapping.mirror import MapMirror
from companion.mapping.voxel_map import VoxelMap, VoxelMapConfig
from tests.unit.mapping.failing_shelf import FailingShelf

NEVER = MemoryConfig(keep_m=1e5)
EAGER = MemoryConfig(keep_m=0.0, regions_per_scan=4)
BIG = 10**9
SLAB_MB = 1e-6 * BlockStore().memory_bytes  # the least that a store takes


def make(memory, resolution_m=0.2, range_m=6.0, decays=False, shelf=None):
    config = VoxelMapConfig(
        resolution_m=resolution_m, max_range_m=range_m, miss_clear_range_m=range_m / 2, memory=memory
    )
    return VoxelMap(config, decays=decays, shelf=shelf)


def look(voxels, at, seed, returns=60):
    """One scan from `at` (3,): returns and misses all around, as `seed` has it."""
    rng = np.random.default_rng(seed)
    points, dirs = rng.normal(size=(returns, 3)) * 3.0, rng.normal(size=(20, 3))
    at = np.asarray(at, np.float64)
    voxels.insert(
        points.astype(np.float32),
        R_odom_body=np.eye(3),
        p_odom=at,
        origin_odom=at,
        miss_dirs_body=dirs.astype(np.float32),
        stamp_ns=1000 + 7 * seed,
    )


def whole(voxels):
    """Every bit of the map, in the order of `parts`."""
    parts = list(voxels.memory.parts())
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def digest(voxels):
    return hashlib.sha256(b"".join(array.tobytes() for array in whole(voxels).values())).hexdigest()


def assert_same(voxels, other):
    left, right = whole(voxels), whole(other)
    assert left.keys() == right.keys()
    for name in left:
        assert np.array_equal(left[name], right[name]), name


def random_region(rng, count, corner):
    """`count` blocks of the region at `corner` blocks, in order of their places."""
    key = int(keys_of(regions_of(np.array([corner])))[0])
    xyz = all_blocks(key)[np.sort(rng.permutation(256)[:count])]
    return key, {
        "xyz": xyz.astype(np.int32),
        "log_odds": rng.integers(-128, 128, (count, 512)).astype(np.int8),
        "changed_at": rng.integers(0, 2**62, count),
        "seen_ns": rng.integers(-(2**62), 2**62, count),
        "held": rng.integers(0, 2, count).astype(np.uint8),
        "stirred": rng.integers(0, 5, count).astype(np.uint8),
        "marks": (rng.integers(0, 2**63, (count, 6, 8)) * rng.integers(0, 2, (count, 1, 1))).astype(np.uint64),
    }


@given(st.integers(0, BIG), st.integers(1, 256), st.tuples(*[st.integers(-(2**19), 2**19)] * 3))
@settings(max_examples=60, deadline=None)
def test_a_packed_region_comes_back_as_it_was(seed, count, corner):
    key, blocks = random_region(np.random.default_rng(seed), count, corner)
    region = pack(blocks)
    again = unpack(region, key)
    assert list(again) == list(blocks)
    for name, array in blocks.items():
        assert again[name].dtype == array.dtype
        assert np.array_equal(again[name], array), name
    assert (region.count, region.changes) == (count, (blocks["changed_at"].min(), blocks["changed_at"].max()))
    assert region.held == bool(blocks["held"].any())


levels = st.sampled_from([[-128], [-128, -1], list(range(-128, 128)), [-128, *range(-7, 0)], [5], [0, -7]])


@given(st.integers(0, BIG), levels, st.sampled_from([1, 2, 100, 256]), st.floats(0.0, 1.0))
@settings(max_examples=60, deadline=None)
def test_cells_of_any_values_come_back(seed, values, count, often):
    """Any mixture: one value alone, all 256, most of them rare."""
    rng = np.random.default_rng(seed)
    places = np.sort(rng.permutation(256)[:count])
    cells = rng.choice(np.array(values, np.int8), (count, 512))
    cells[rng.random(cells.shape) < often] = values[0]
    assert np.array_equal(decode(encode(places, cells), places), cells)


def test_cells_that_are_alike_take_few_bytes():
    places, rng = np.arange(256), np.random.default_rng(0)
    assert len(encode(places, np.full((256, 512), -128, np.int8))) < 60
    smooth = -np.clip(np.arange(512) // 64 + rng.integers(0, 2, (256, 512)), 1, 7)
    noise_bits = 1.0  # per cell
    assert len(encode(places, smooth.astype(np.int8))) < 1.25 * 256 * 512 * noise_bits / 8


@given(st.lists(st.tuples(*[st.integers(-(2**20), 2**20 - 1)] * 3), min_size=1, max_size=50))
@settings(deadline=None)
def test_keys_are_ordered_unique_and_turn_back_into_positions(block_xyz):
    xyz = np.array(sorted(block_xyz))
    regions = regions_of(xyz)
    assert np.array_equal(regions, xyz // [8, 8, 4])
    keys = keys_of(regions)
    assert np.array_equal(positions_of(keys), regions)
    assert [region_key(*position) for position in xyz] == keys.tolist()
    assert np.array_equal(keys[np.lexsort(regions.T[::-1])], np.sort(keys))
    places = places_of(xyz)
    assert all(np.array_equal(all_blocks(int(k))[p], at) for k, p, at in zip(keys, places, xyz, strict=True))


steps = st.lists(st.tuples(st.integers(-9, 9), st.integers(-9, 9), st.integers(-4, 4)), min_size=1, max_size=25)


@given(steps, st.integers(0, 1000), st.integers(1, 9), st.sampled_from([0.0, 3.0, 8.0]))
@settings(max_examples=40, deadline=None)
def test_over_random_walks_the_map_is_the_one_without_eviction(walk, seed, few, keep_m):
    plain, lean = make(NEVER), make(MemoryConfig(keep_m=keep_m, regions_per_scan=few))
    at = np.zeros(3)
    probe = np.random.default_rng(seed).normal(size=(300, 3)) * 15.0
    for n, step in enumerate(walk):
        at = at + 0.5 * np.array(step)
        for voxels in (plain, lean):
            look(voxels, at, seed + n)
    assert_same(plain, lean)
    assert plain.version == lean.version
    assert plain.block_count == lean.block_count
    assert np.array_equal(plain.query(probe), lean.query(probe), equal_nan=True)
    for version in (-1, 0, plain.version // 2, plain.version - 1, plain.version):
        assert np.array_equal(*[in_region_order(voxels.changed_since(version)) for voxels in (plain, lean)])
    assert np.array_equal(plain.occupied_centers(), lean.occupied_centers())


@given(steps, st.integers(0, 1000), st.sampled_from([0.0, 3.0, 8.0]), st.sampled_from([0.0, 1.5]))
@settings(max_examples=40, deadline=None)
def test_with_decay_the_map_is_the_one_without_eviction(walk, seed, keep_m, forget_unseen_s):
    """Marks go and come with the blocks: the same cells decay, now and long after a return."""
    config = DecayConfig(period_s=0.2, crowd=1, forget_unseen_s=forget_unseen_s)
    pair = [make(NEVER, decays=True), make(MemoryConfig(keep_m=keep_m, regions_per_scan=9), decays=True)]
    passes = [Decay(config), Decay(config)]
    at, rng = np.zeros(3), np.random.default_rng(seed)
    for n, step in enumerate([*walk, *[(0, 0, 0)] * 6, *[tuple(-b for b in back) for back in walk[::-1]]]):
        at = at + 0.5 * np.array(step)
        stamp_ns, points = n * 10**8, rng.normal(size=(80, 3)) * 2.0
        forgotten = []
        for voxels, one in zip(pair, passes, strict=True):
            voxels.insert(
                points.astype(np.float32), R_odom_body=np.eye(3), p_odom=at, origin_odom=at, stamp_ns=stamp_ns
            )
            forgotten.append(one.after_scan(voxels, stamp_ns))
        assert len(forgotten[0]) == len(forgotten[1])
    assert_same(*pair)
    assert pair[0].version == pair[1].version


def test_only_blocks_in_which_something_stands_have_marks():
    voxels, passes = make(NEVER, decays=True), Decay(DecayConfig())
    for n in range(60):
        look(voxels, (0.2 * n, 0.0, 1.0), n)
        passes.after_scan(voxels, n * 10**8)
    for n in range(60, 120):  # from afar: all passes are made
        look(voxels, (60.0, 0.0, 1.0), 5, returns=0)
        passes.after_scan(voxels, n * 10**8)
    parts = whole(voxels)
    occupied = np.any(parts["log_odds"] >= 0, axis=1)
    assert np.array_equal(occupied, np.any(parts["marks"], axis=(1, 2)))
    assert 0 < np.count_nonzero(occupied) < len(occupied)
    assert not parts["stirred"].any()
    slots = voxels.blocks._slots[: voxels.blocks.count]
    table = voxels.blocks._marks
    assert len(np.unique(slots[slots > 0])) == np.count_nonzero(occupied)
    free = table.free[: table.left[0]]
    assert np.array_equal(np.sort(np.concatenate([free, slots[slots > 0]])), np.arange(1, len(table.bits)))
    assert not table.bits[free].any()


@pytest.mark.parametrize("room", [0, 20_000, 10**9])
def test_a_shelf_changes_nothing_of_the_map_even_when_it_is_full(room):
    shelf = FailingShelf(room)
    plain, lean = there_and_back(EAGER), there_and_back(EAGER, shelf=shelf)
    assert digest(plain) == digest(lean)
    assert lean.memory_bytes == plain.memory_bytes
    shelves = lean.memory.cold.shelves
    assert (shelves.refusal is None) == (room == 10**9)
    assert (len(shelf.kept) > 0) == (room > 0)
    assert shelves.outside_bytes + shelves.inside_bytes == plain.memory.cold.shelves.inside_bytes
    while lean.let_go(1000):
        pass
    assert shelves.outside_bytes == shelves.inside_bytes == lean.memory.memory_bytes == 0


def test_without_spill_nothing_goes_on_a_shelf():
    shelf = FailingShelf()
    lean = there_and_back(MemoryConfig(keep_m=0.0, regions_per_scan=4, spill=False), shelf=shelf)
    assert not shelf.kept
    assert lean.memory.cold_regions > 0 == lean.memory.spilled_bytes


def test_what_cannot_be_read_again_is_forgotten_counted_and_told():
    plain, lean = there_and_back(NEVER), there_and_back(EAGER, shelf=FailingShelf(breaks=30))
    wanted, parts = whole(plain), whole(lean)
    lost = lean.memory.cold.lost_blocks
    assert 0 < lost == lean.memory.forgotten_blocks
    kept = {tuple(p): n for n, p in enumerate(wanted["xyz"].tolist())}
    assert {tuple(p) for p in parts["xyz"].tolist()} <= kept.keys()
    assert len(parts["xyz"]) >= len(kept) - lost
    left = {tuple(p) for p in lean.changed_since(-1).tolist()}
    assert left == kept.keys()


def test_mirrors_forget_what_the_budget_made_the_map_forget():
    lean, mirror = make(MemoryConfig(keep_m=6.0, budget_mb=SLAB_MB + 0.4), 0.1), MapMirror()
    for n in range(300):
        look(lean, (n, 0.0, 1.0), n, returns=30)
        delta = delta_since(lean, mirror.version, stamp_ns=n, map_ns=0)
        assert delta is None or mirror.take(delta)
    assert lean.memory.forgotten_blocks > 100
    records = records_of(lean, np.concatenate([part["xyz"] for part in lean.memory.parts()]))
    have = mirror.voxels.memory.parts()
    known = {tuple(x) for part in have for x in part["xyz"][np.any(part["log_odds"] != -128, axis=1)].tolist()}
    assert known == {tuple(r["xyz"].tolist()) for r in records if r["states"].any()}


def there_and_back(memory, length_m=60.0, step_m=1.0, shelf=None):
    voxels = make(memory, shelf=shelf)
    way = np.arange(0.0, length_m, step_m)
    for n, x in enumerate(np.concatenate([way, way[::-1]])):
        look(voxels, (x, 0.3 * np.sin(x), 1.0), n)
    return voxels


def test_there_and_back_gives_the_same_map_and_the_same_bytes_again():
    plain, lean, again = there_and_back(NEVER), there_and_back(EAGER), there_and_back(EAGER)
    assert plain.memory.cold_regions == 0
    assert lean.memory.cold_regions > 20
    assert_same(plain, lean)
    assert digest(lean) == digest(again)
    count = lean.blocks.count
    assert count == again.blocks.count < plain.blocks.count / 3
    assert np.array_equal(lean.blocks.xyz[:count], again.blocks.xyz[:count])  # even the rows
    for name, array in plain.to_arrays().items():
        assert np.array_equal(array, lean.to_arrays()[name])


def test_no_cold_region_is_ever_within_reach_even_after_a_jump():
    lean = make(MemoryConfig(keep_m=4.0, regions_per_scan=1))
    rng, reach = np.random.default_rng(3), 6.0
    for n, at in enumerate(rng.uniform(-50, 50, (60, 3)) * [1, 1, 0.2]):
        look(lean, at, n)
        lean.window(np.floor(at / 1.6).astype(np.int64) - 2, np.empty((32, 32, 32), np.uint8))
        edge = np.array([12.8, 12.8, 6.4])
        low = positions_of(np.array(list(lean.memory.cold.regions), np.int64)) * edge
        gap = np.maximum(np.maximum(low - at, at - low - edge), 0.0)
        assert len(gap) == 0 or np.linalg.norm(gap, axis=1).min() > reach
    assert lean.memory.cold_regions > 20


@pytest.mark.parametrize("few", [1, 3])
def test_each_scan_moves_at_most_so_many_regions(few):
    lean = make(MemoryConfig(keep_m=8.0, regions_per_scan=few))
    way = np.concatenate([np.arange(0.0, 90.0, 1.5), np.arange(90.0, 0.0, -1.5)])
    before, most = set(), 0
    for n, x in enumerate(way):
        look(lean, (x, 0.0, 0.0), n)
        cold = set(lean.memory.cold.regions)
        assert len(cold - before) <= few
        most = max(most, len(before - cold))
        before = cold
    assert len(cold) > 0
    if few == 3:
        assert most <= few  # fetched ahead in time: none had to come at once


def test_a_window_beyond_the_rays_sees_cold_blocks_and_keeps_them():
    plain, lean = there_and_back(NEVER, 40.0), there_and_back(EAGER, 40.0)
    corner, shape = np.array([-4, -8, -4]), (8 * 30, 8 * 16, 8 * 8)
    cold = lean.memory.cold_regions
    for n in range(3):
        seen, wanted = np.empty(shape, np.uint8), np.empty(shape, np.uint8)
        plain.window(corner, wanted)
        lean.window(corner, seen)
        assert np.array_equal(seen, wanted)
        left = lean.memory.cold_regions
        for voxels in (plain, lean):
            look(voxels, (0.0, 0.0, 1.0), 500 + n)
        assert lean.memory.cold_regions == left < cold
    assert_same(plain, lean)


def test_blocks_are_read_wherever_they_lie():
    plain, lean = there_and_back(NEVER), there_and_back(EAGER)
    xyz = whole(plain)["xyz"].astype(np.int64)
    nowhere = xyz + np.array([0, 0, 500])
    asked = np.random.default_rng(0).permutation(np.concatenate([xyz, nowhere]))
    cold = lean.memory.cold_regions
    assert np.array_equal(plain.memory.log_odds_of(asked), lean.memory.log_odds_of(asked))
    assert np.all(lean.memory.log_odds_of(nowhere) == -128)
    assert lean.memory.cold_regions == cold  # reading moves nothing


def test_a_whole_walk_for_late_joiners_tells_of_cold_blocks():
    plain, lean = there_and_back(NEVER), there_and_back(EAGER)
    for voxels in (plain, lean):
        walk, full = FullWalk(voxels, map_ns=0), None
        while full is None:
            full = walk.advance(voxels, blocks=250, stamp_ns=5)
        records = records_from(full)
        xyz = whole(plain)["xyz"]
        assert np.array_equal(in_region_order(records["xyz"]), xyz)
        order = np.lexsort(xyz.T[::-1])
        wanted = whole(plain)["log_odds"][order]
        states = states_of(records[np.lexsort(records["xyz"].T[::-1])])
        assert np.array_equal(states, np.where(wanted == -128, 0, np.where(wanted < 0, 1, 2)))


def test_blocks_of_a_loaded_map_stay_so_when_they_were_away():
    loaded = VoxelMap.from_arrays(there_and_back(EAGER).to_arrays(), make(EAGER).config)
    for n in range(80):
        look(loaded, (0.5 * n, 40.0, 1.0), n)
    parts = whole(loaded)
    assert loaded.memory.cold_regions > 20
    assert parts["held"].sum() == there_and_back(EAGER).block_count
    assert 0 < parts["held"].sum() < len(parts["held"])


def test_blocks_added_to_a_cold_region_join_it():
    lean = there_and_back(EAGER)
    lean.memory.bring_back((np.zeros(3, np.int64), np.zeros(3, np.int64)))
    count, key = lean.block_count, next(iter(lean.memory.cold.regions))
    taken = {tuple(p) for p in lean.memory.cold.read(key)["xyz"].tolist()}
    place = next(p for p in all_blocks(key).tolist() if tuple(p) not in taken)
    lean.blocks.add(np.array([place], np.int32), np.full((1, 512), 5, np.int8), lean.steps.lowest, False)
    assert lean.block_count == count + 1
    before = digest(lean)
    for _ in range(3):
        lean.memory.before_scan(np.zeros(3, np.int64), 1)
    assert digest(lean) == before
    assert lean.memory.cold.regions[key].count == len(taken) + 1


def walk_far(memory, scans=300, step_m=1.0):
    voxels, most = make(memory, 0.1), 0
    for n in range(scans):
        look(voxels, (step_m * n, 0.0, 1.0), n, returns=30)
        most = max(most, voxels.memory_bytes)
    return voxels, most


def test_memory_is_bounded_over_a_long_walk_and_what_was_forgotten_is_counted():
    plain, unbounded = walk_far(NEVER)
    budget_mb = SLAB_MB + 0.4
    assert unbounded > 2.5e6 * budget_mb
    lean, most = walk_far(MemoryConfig(keep_m=6.0, budget_mb=budget_mb))
    assert most < 1.2e6 * budget_mb
    assert lean.memory.forgotten_blocks > 0
    assert lean.block_count + lean.memory.forgotten_blocks >= plain.block_count
    known = keys_of(whole(lean)["xyz"].astype(np.int64))
    wanted = whole(plain)
    kept = np.isin(keys_of(wanted["xyz"].astype(np.int64)), known)
    for name, array in whole(lean).items():
        if name != "changed_at":  # forgetting takes versions
            assert np.array_equal(array, wanted[name][kept]), name  # all that is kept is right
    start, end, middle = (np.count_nonzero(np.abs(wanted["xyz"][kept, 0] - b) < 20) for b in (0, 374, 187))
    assert start > 0
    assert end > 0
    assert middle == 0  # the farthest from both goes first


def test_what_fits_when_compressed_is_not_forgotten():
    plain, unbounded = walk_far(NEVER)
    lean, most = walk_far(MemoryConfig(keep_m=400.0, budget_mb=unbounded * 0.6e-6))
    assert lean.memory.forgotten_blocks == 0
    assert lean.memory.cold_regions > 0
    assert most < 0.7 * unbounded
    assert_same(plain, lean)


def test_a_loaded_map_is_forgotten_last():
    config = make(MemoryConfig(keep_m=0.0, budget_mb=SLAB_MB + 0.2)).config
    loaded = VoxelMap.from_arrays(there_and_back(EAGER, 20.0).to_arrays(), config)
    held = int(loaded.blocks.held.sum())
    for n in range(300):
        look(loaded, (30.0 + n, 0.0, 1.0), n)
    assert loaded.memory.forgotten_blocks > 0
    assert whole(loaded)["held"].sum() == held
