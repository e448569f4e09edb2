"""The map as messages: a mirror has the sender's classes, whenever it joins and whatever it misses."""

import dataclasses

import lz4.frame
import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.core.errors import InputError
from companion.core.topics import MAP_DELTA, MAP_FULL, OCCUPIED
from companion.mapping.deltas import FullWalk, delta_since, records_of, states_of, unpack
from companion.mapping.memory import MemoryConfig
from companion.mapping.mirror import MapMirror
from companion.mapping.sensor_model import UNKNOWN
from companion.mapping.share import MapShare, ShareConfig, occupied_near
from companion.mapping.voxel_map import VoxelMap, VoxelMapConfig

CONFIG = VoxelMapConfig(max_range_m=6.0, miss_clear_range_m=4.0)
HISTORY = 5  # deltas that a late joiner gets


def look(voxels, rng, *, stamp_ns=0):
    """A scan of a few random returns from somewhere."""
    origin = rng.uniform(-9, 9, 3)
    voxels.insert(
        rng.normal(size=(int(rng.integers(1, 12)), 3)).astype(np.float32) * 3,
        R_odom_body=np.eye(3),
        p_odom=origin,
        origin_odom=origin,
        stamp_ns=stamp_ns,
    )


def looked(scans, seed=0, config=CONFIG):
    voxels, rng = VoxelMap(config), np.random.default_rng(seed)
    for _ in range(scans):
        look(voxels, rng)
    return voxels


def known_blocks(voxels):
    """Positions (N, 3) and states (N, 512) of the blocks with a known voxel, in order."""
    arrays = voxels.to_arrays()  # those that lie compressed, too
    xyz, levels = arrays["block_xyz"], arrays["log_odds"]
    states = np.where(levels == UNKNOWN, 0, np.where(levels >= 0, 2, 1)).astype(np.uint8)
    order = np.lexsort(xyz.T)
    order = order[states.any(axis=1)[order]]
    return xyz[order], states[order]


def classes(voxels):
    """{block: 512 states}, of blocks with a known voxel."""
    xyz, states = known_blocks(voxels)
    return {tuple(p): cells.tobytes() for p, cells in zip(xyz.tolist(), states, strict=True)}


def digest(voxels):
    """The classes of a whole map as bytes."""
    return b"".join(part.tobytes() for part in known_blocks(voxels))


def whole(voxels, blocks=7):
    walk = FullWalk(voxels, map_ns=3)
    while (full := walk.advance(voxels, blocks=blocks, stamp_ns=9)) is None:
        pass
    return full


@pytest.mark.parametrize("seed", range(3))
def test_records_have_the_states_of_every_voxel(seed):
    voxels = looked(20, seed)
    blocks = voxels.blocks
    rng = np.random.default_rng(seed)
    blocks.log_odds[: blocks.count] = rng.integers(-128, 128, (blocks.count, 512))
    records = records_of(voxels, blocks.xyz[: blocks.count])
    cells = np.arange(512)
    for record, states, levels in zip(records, states_of(records), blocks.log_odds, strict=False):
        by_hand = [int(record["states"][c >> 2]) >> 2 * (c & 3) & 3 for c in cells]
        assert by_hand == np.where(levels == UNKNOWN, 0, np.where(levels >= 0, 2, 1)).tolist() == states.tolist()


def test_a_block_that_is_not_there_is_sent_as_unknown():
    records = records_of(looked(5), np.array([[900, -900, 3]], np.int32))
    assert records["xyz"].tolist() == [[900, -900, 3]] and not records["states"].any()


def test_a_delta_holds_the_changed_blocks_alone_and_nothing_gives_none():
    voxels = looked(30)
    before, version = classes(voxels), voxels.version
    assert delta_since(voxels, version, stamp_ns=1, map_ns=0) is None
    look(voxels, np.random.default_rng(5))
    delta = delta_since(voxels, version, stamp_ns=1, map_ns=0)
    after = classes(voxels)
    named = {tuple(xyz) for xyz in unpack(delta)["xyz"].tolist()}
    assert named == {block for block in after if after[block] != before.get(block)}
    assert (delta.version_from, delta.version_to, delta.block_count) == (version, voxels.version, len(named))


def test_a_large_change_is_told_in_pieces():
    voxels, rng, mirror = VoxelMap(CONFIG), np.random.default_rng(4), MapMirror()
    share = MapShare(ShareConfig(delta_every=5, delta_blocks=30, full_every=0, occupied_every=0))
    sizes = []
    for k in range(60):
        if k < 30:
            look(voxels, rng, stamp_ns=k)
        if k == 12:  # as a correction: everything changes, in a few versions
            count = voxels.blocks.count
            for rows in np.array_split(np.arange(count), -(-count // 20)):
                voxels.blocks.write(rows, -voxels.blocks.log_odds[rows], voxels.steps.lowest)
        for output in share.after_scan(voxels, np.zeros(3), stamp_ns=k):
            sizes.append(output.message.block_count)
            assert mirror.take(output.message)
    assert max(sizes) < 30 + 60 < voxels.block_count  # what one scan changes is not cut
    assert mirror.version == voxels.version
    assert classes(mirror.voxels) == classes(voxels)


def test_the_end_of_a_whole_map_is_bounded_when_all_changed_meanwhile(monkeypatch):
    monkeypatch.setattr("companion.mapping.deltas._AT_ONCE", 10)
    voxels = looked(30)
    walk, full, count, most = FullWalk(voxels, map_ns=0), None, 0, 0
    for k in range(200):
        full = walk.advance(voxels, blocks=20, stamp_ns=0)
        most, count = max(most, walk._count - count), walk._count
        if k in (2, 9):  # while it runs
            rows = np.arange(voxels.blocks.count)
            voxels.blocks.write(rows, -voxels.blocks.log_odds[rows], voxels.steps.lowest)
        if full is not None:
            break
    assert most <= 20 + 10
    mirror = MapMirror()
    assert mirror.take(full)
    assert classes(mirror.voxels) == classes(voxels)


def test_the_same_map_gives_the_same_bytes_whatever_the_order_of_its_blocks():
    one = looked(30)
    other = VoxelMap(CONFIG)
    arrays, mixed = one.to_arrays(), np.random.default_rng(1).permutation(one.block_count)
    other.blocks.add(arrays["block_xyz"][mixed], arrays["log_odds"][mixed], one.steps.lowest, held=False)
    assert whole(one).data == whole(other).data


def publish(seed, scans):
    """(messages per scan, classes by version, the map) of a flight with its share."""
    rng = np.random.default_rng(seed)
    share = MapShare(
        ShareConfig(
            delta_every=int(rng.integers(1, 4)),
            full_every=int(rng.integers(1, 9)),
            full_blocks_per_scan=int(rng.integers(1, 30)),
            occupied_every=0,
        )
    )
    voxels, said, snapshots = VoxelMap(CONFIG), [], {}
    for k in range(scans):
        look(voxels, rng, stamp_ns=k)
        if rng.random() < 0.2:  # decay, or a correction, makes blocks unknown again
            rows = np.unique(rng.integers(0, max(voxels.blocks.count, 1), 2))[: voxels.blocks.count]
            voxels.blocks.write(rows, np.full((len(rows), 512), UNKNOWN, np.int8), voxels.steps.lowest)
        snapshots[voxels.version] = digest(voxels)
        said.append([(o.topic, o.message) for o in share.after_scan(voxels, np.zeros(3), stamp_ns=k)])
    return said, snapshots, voxels


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 10_000), joins_at=st.integers(0, 25), loss=st.sampled_from([0.0, 0.1, 0.5]))
def test_a_mirror_equals_the_sender_whenever_it_joins_and_whatever_it_misses(seed, joins_at, loss):
    said, snapshots, _ = publish(seed, 40)
    rng = np.random.default_rng(seed)
    earlier = [entry for entries in said[:joins_at] for entry in entries]
    kept = [m for t, m in earlier if t is MAP_FULL][-1:] + [m for t, m in earlier if t is MAP_DELTA][-HISTORY:]
    mirror = MapMirror()
    for n in rng.permutation(len(kept)):
        mirror.take(kept[n])
    for entries in said[joins_at:]:
        for n in rng.permutation(len(entries)):
            if rng.random() >= loss:
                mirror.take(entries[n][1])
            if mirror.voxels is not None:  # behind, perhaps, but never wrong
                assert digest(mirror.voxels) == snapshots[mirror.version]
    if not loss:
        fulls = [m for entries in said for t, m in entries if t is MAP_FULL]
        assert mirror.version >= fulls[-1].version_to
        if joins_at == 0:
            newest = max(m.version_to for entries in said for _, m in entries)
            assert (mirror.current, mirror.version, mirror.gaps) == (True, newest, 0)


def test_a_gap_is_noticed_and_the_next_full_map_mends_it():
    voxels, rng, mirror = looked(10), np.random.default_rng(1), MapMirror()
    assert mirror.take(whole(voxels)) and mirror.gaps == 0
    deltas = []
    for k in range(3):
        version = voxels.version
        look(voxels, rng)
        deltas.append(delta_since(voxels, version, stamp_ns=k, map_ns=3))
    assert not mirror.take(deltas[1]) and not mirror.take(deltas[2])
    assert (mirror.gaps, mirror.version) == (1, deltas[0].version_from)
    assert mirror.take(whole(voxels)) and mirror.version == voxels.version
    assert classes(mirror.voxels) == classes(voxels)


def test_what_was_late_closes_the_gap_itself():
    voxels, rng, mirror = looked(10), np.random.default_rng(1), MapMirror()
    mirror.take(whole(voxels))
    deltas = []
    for k in range(4):
        version = voxels.version
        look(voxels, rng)
        deltas.append(delta_since(voxels, version, stamp_ns=k, map_ns=3))
    assert [mirror.take(deltas[k]) for k in (3, 1, 2, 0)] == [False, False, False, True]
    assert classes(mirror.voxels) == classes(voxels)


def test_a_map_that_begins_anew_replaces_the_old_one():
    old, new, mirror = looked(10, 0), looked(4, 7), MapMirror()
    mirror.take(whole(old))
    delta = delta_since(new, new.version - 1, stamp_ns=5, map_ns=99)
    assert not mirror.take(delta) and mirror.voxels is None
    assert mirror.take(dataclasses.replace(whole(new), map_ns=99))
    assert classes(mirror.voxels) == classes(new)


def test_a_full_map_names_what_is_gone():
    voxels, mirror = looked(10), MapMirror()
    mirror.take(whole(voxels))
    known = len(classes(voxels))
    voxels.blocks.write(np.arange(4), np.full((4, 512), UNKNOWN, np.int8), voxels.steps.lowest)
    voxels.blocks.remove(np.arange(4))  # and nobody says so but the next whole map
    mirror.take(whole(voxels))
    assert len(classes(mirror.voxels)) == known - 4 and classes(mirror.voxels) == classes(voxels)


def test_the_mirror_tells_what_changed_as_the_map_does():
    voxels, mirror = looked(10), MapMirror()
    mirror.take(whole(voxels))
    before, version, sent = classes(voxels), mirror.voxels.version, voxels.version
    look(voxels, np.random.default_rng(9))
    mirror.take(delta_since(voxels, sent, stamp_ns=1, map_ns=3))
    after = classes(voxels)
    changed = {tuple(xyz) for xyz in mirror.voxels.changed_since(version).tolist()}
    assert changed == {block for block in after if after[block] != before.get(block)}


def damage(full, what, map_ns):
    raw = bytearray(lz4.frame.decompress(full.data))
    changes = {
        "cut": {"data": full.data[:-3]},
        "count": {"block_count": full.block_count + 1},
        "fewer": {"block_count": full.block_count - 1},
        "negative": {"block_count": -1},
        "huge": {"block_count": 2**40},
        "noise": {"data": b"\x12\x34" + full.data},
        "empty": {"data": b""},
        "state 3": {"data": lz4.frame.compress(bytes(raw[:12]) + b"\xff" + bytes(raw[13:]))},
        "far": {"data": lz4.frame.compress(b"\xff\xff\xff\x7f" + bytes(raw[4:]))},
        "bomb": {"data": lz4.frame.compress(bytes(100_000_000))},
        "resolution": {"resolution_m": float("nan")},
    }
    return dataclasses.replace(full, version_to=full.version_to + 1, map_ns=map_ns, **changes[what])


@pytest.mark.parametrize(
    "what",
    ["cut", "count", "fewer", "negative", "huge", "noise", "empty", "state 3", "far", "bomb", "resolution"],
)
def test_damaged_messages_are_refused_and_change_nothing(what):
    voxels, mirror = looked(10), MapMirror()
    full = whole(voxels)
    mirror.take(full)
    for map_ns in (full.map_ns, 99):
        with pytest.raises(InputError, match=r"data|block_count|resolution_m"):
            mirror.take(damage(full, what, map_ns))
    assert classes(mirror.voxels) == classes(voxels) and mirror.version == full.version_to and mirror.current


def test_flipped_bytes_never_do_more_than_raise():
    voxels = looked(10)
    full = whole(voxels)
    rng, refused = np.random.default_rng(0), 0
    for _ in range(300):
        data = bytearray(full.data)
        data[int(rng.integers(len(data)))] ^= 1 << int(rng.integers(8))
        mirror = MapMirror()
        try:
            mirror.take(dataclasses.replace(full, data=bytes(data)))
        except InputError:
            assert mirror.voxels is None and mirror.version == 0
            refused += 1
        else:  # a bit that fills a byte up
            assert classes(mirror.voxels) == classes(voxels)
    assert refused > 250


def test_the_work_of_a_whole_map_is_bounded_per_scan_and_nothing_goes_unchanged():
    voxels = looked(30)
    share = MapShare(ShareConfig(full_blocks_per_scan=20, full_every=3, delta_every=2, occupied_every=4))
    said = [[o.topic for o in share.after_scan(voxels, np.zeros(3), stamp_ns=k)] for k in range(40)]
    steps = -(-voxels.block_count // 20)
    assert steps > 3
    assert [k for k, topics in enumerate(said) if MAP_FULL in topics] == [steps - 1]
    assert [k for k, topics in enumerate(said) if MAP_DELTA in topics] == [0]
    assert [k for k, topics in enumerate(said) if OCCUPIED in topics] == [0]
    silent = MapShare(ShareConfig(full_every=0, delta_every=0, occupied_every=0))
    assert not list(silent.after_scan(voxels, np.zeros(3), stamp_ns=0))


def test_occupied_voxels_are_those_of_the_map_within_the_radius():
    voxels = looked(60, config=msgspec.structs.replace(CONFIG, memory=MemoryConfig(keep_m=100.0)))  # nothing is cold
    points, log_odds = occupied_near(voxels, np.zeros(3), 1000.0)
    centers = voxels.occupied_centers()
    assert np.allclose(points[np.lexsort(points.T)], centers[np.lexsort(centers.astype(np.float32).T)], atol=1e-5)
    assert np.array_equal(log_odds, voxels.query(points))
    p, radius_m = np.array([2.0, -1.0, 0.5]), 7.0
    near, _ = occupied_near(voxels, p, radius_m)
    block_centers = (np.floor(points / 1.6) + 0.5) * 1.6
    inside = np.linalg.norm(block_centers - p, axis=1) < radius_m
    assert 0 < inside.sum() < len(points) and np.array_equal(near, points[inside])
