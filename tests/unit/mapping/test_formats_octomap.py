"""Our .bt and .ot against OctoMap itself (pyoctomap), in both directions."""

import math
import struct
from contextlib import suppress

import numpy as np
import pyoctomap
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.core.errors import InputError
from companion.mapping.formats.morton import cells_in_order, deinterleave, interleave
from companion.mapping.formats.octomap import read_octomap, write_bt, write_ot
from companion.mapping.formats.octree import blocks_of, tree_of
from companion.mapping.formats.stored_map import StoredMap
from companion.mapping.sensor_model import UNKNOWN, quantise
from tests.unit.mapping.random_maps import OCTOMAPS, OURS, classes, random_map, same

SEEDS = st.integers(0, 10_000)


def of_octomap(data, path):
    """The tree that OctoMap reads from our bytes."""
    path.write_bytes(data)
    if path.suffix == ".ot":
        return pyoctomap.OcTree(0.5).read(str(path))
    tree = pyoctomap.OcTree(0.5)
    assert tree.readBinary(str(path))
    return tree


def centers_and_steps(stored):
    row, cell = np.nonzero(stored.log_odds != UNKNOWN)
    inside = np.stack([cell >> 6, (cell >> 3) & 7, cell & 7], axis=1)
    return (8 * stored.block_xyz[row] + inside + 0.5) * stored.resolution_m, stored.log_odds[row, cell]


def leaf_voxels(tree):
    """How many voxels all leaves span."""
    return sum(8 ** (16 - leaf.getDepth()) for leaf in tree.begin_leafs())


def grown(seed, resolution_m=0.2):
    """A tree that OctoMap made from rays, pruned by it."""
    rng = np.random.default_rng(seed)
    tree = pyoctomap.OcTree(resolution_m)
    for _ in range(3):
        points = rng.normal(size=(150, 3)) * [4, 4, 1] + rng.uniform(-2, 2, 3)
        tree.insertPointCloud(points, rng.uniform(-1, 1, 3))
    tree.updateInnerOccupancy()
    return tree


@settings(max_examples=8, deadline=None)
@given(seed=SEEDS)
def test_octomap_reads_every_voxel_that_we_wrote(seed, tmp_path_factory):
    stored = random_map(seed, blocks=4)
    centers, steps = centers_and_steps(stored)
    folder = tmp_path_factory.mktemp("trees")
    for suffix, data in ((".bt", write_bt(stored)), (".ot", write_ot(stored))):
        tree = of_octomap(data, folder / f"map{suffix}")
        assert tree.getResolution() == stored.resolution_m
        assert leaf_voxels(tree) == len(steps)  # none that is not ours
        for center, step in zip(centers[::7], steps[::7], strict=True):
            node = tree.search(center)
            assert tree.isNodeOccupied(node) == (step >= 0)
            if suffix == ".ot":
                assert node.getLogOdds() == pytest.approx(step / quantise(OURS).per_unit, abs=1e-6)


@settings(max_examples=8, deadline=None)
@given(seed=SEEDS)
def test_we_read_every_voxel_that_octomap_wrote(seed, tmp_path_factory):
    folder = tmp_path_factory.mktemp("trees")
    tree = grown(seed)
    assert tree.write(str(folder / "map.ot"))
    full = read_octomap((folder / "map.ot").read_bytes(), sensor=OCTOMAPS)
    centers, steps = centers_and_steps(full)
    assert leaf_voxels(tree) == len(steps)
    per_unit = quantise(OCTOMAPS).per_unit
    for center, step in zip(centers[::11], steps[::11], strict=True):
        node = tree.search(center)
        assert tree.isNodeOccupied(node) == (step >= 0)
        assert abs(step / per_unit - node.getLogOdds()) <= 1.0 / per_unit  # half a step, or a whole one to stay free
    assert tree.writeBinary(str(folder / "map.bt"))
    assert same(read_octomap((folder / "map.bt").read_bytes(), sensor=OCTOMAPS), classes(full))


@settings(max_examples=20, deadline=None)
@given(seed=SEEDS)
def test_round_trips_lose_nothing(seed):
    stored = random_map(seed)
    assert same(read_octomap(write_ot(stored)), stored)
    assert same(read_octomap(write_bt(stored)), classes(stored))


def test_what_octomap_wrote_is_written_again_byte_for_byte(tmp_path):
    tree = grown(3)
    assert tree.writeBinary(str(tmp_path / "map.bt"))
    theirs = (tmp_path / "map.bt").read_bytes()
    ours = write_bt(read_octomap(theirs))
    assert ours[ours.index(b"\ndata\n") :] == theirs[theirs.index(b"\ndata\n") :]


def test_colour_and_stamped_trees_are_read_without_their_extras(tmp_path):
    for kind in (pyoctomap.OcTree, pyoctomap.ColorOcTree, pyoctomap.OcTreeStamped):
        tree = kind(0.1)
        for point in ([0.05, 0.05, 0.05], [1.0, -2.0, 0.3]):
            tree.updateNode(point, True)
        tree.updateInnerOccupancy()
        assert tree.write(str(tmp_path / "map.ot"))
        stored = read_octomap((tmp_path / "map.ot").read_bytes())
        assert stored.resolution_m == 0.1
        assert np.allclose(sorted(stored.occupied()[0].tolist()), [[0.05, 0.05, 0.05], [1.05, -1.95, 0.35]])


def test_an_empty_map_is_an_empty_tree(tmp_path):
    empty = StoredMap(0.2, OURS, np.empty((0, 3), np.int32), np.empty((0, 512), np.int8))
    for suffix, data in ((".bt", write_bt(empty)), (".ot", write_ot(empty))):
        assert len(read_octomap(data).block_xyz) == 0
        assert of_octomap(data, tmp_path / f"map{suffix}").size() == 0


def test_the_largest_map_of_octomap_is_written_and_one_voxel_more_is_refused():
    cells = np.full((2, 512), -1, np.int8)
    corners = np.array([[-4096, -4096, -4096], [4095, 4095, 4095]], np.int32)
    assert same(read_octomap(write_ot(StoredMap(0.2, OURS, corners, cells))), StoredMap(0.2, OURS, corners, cells))
    with pytest.raises(InputError, match="32768 voxels"):
        write_bt(StoredMap(0.2, OURS, np.add(corners, [[0, 0, 0], [0, 0, 1]], dtype=np.int32), cells))


def test_eight_equal_children_become_one_leaf_at_any_depth():
    cube = np.indices((4, 4, 4)).reshape(3, -1).T.astype(np.int32)
    levels = tree_of(cube, np.full((64, 512), 5, np.int8))
    assert [len(level.value) for level in levels] == [1] * 12 + [0] * 5  # a leaf of 4 blocks' edge at depth 11
    assert levels[11].child_mask.tolist() == [0]


def leaf_file(depth, size):
    """An .ot whose one leaf is at `depth`."""
    nodes = (struct.pack("<f", 1.0) + b"\x01") * depth + struct.pack("<f", 1.0) + b"\x00"
    return b"# Octomap OcTree file\nid OcTree\nsize %d\nres 0.1\ndata\n" % size + nodes


def test_a_coarse_leaf_is_expanded_up_to_the_limit():
    stored = read_octomap(leaf_file(11, 12))  # 4 blocks' edge
    assert len(stored.block_xyz) == 64
    assert np.unique(stored.log_odds).tolist() == [quantise(OURS).per_unit.__round__()]
    assert stored.block_xyz.min() == -4096
    assert len(read_octomap(leaf_file(11, 12), most_blocks=64).block_xyz) == 64
    with pytest.raises(InputError, match="64 whole blocks"):
        read_octomap(leaf_file(11, 12), most_blocks=63)
    with pytest.raises(InputError, match=f"{8**13:,} whole blocks"):
        read_octomap(leaf_file(0, 1))


def test_free_stays_free_however_near_to_even(tmp_path):
    nodes = struct.pack("<f", -1e-4) + b"\x00"
    data = leaf_file(16, 17)[:-5] + nodes
    assert read_octomap(data).log_odds.max() == -1


@pytest.mark.parametrize("change, words", [
    (lambda d: b"", "no OctoMap"),
    (lambda d: b"hello\nworld" + d, "no OctoMap"),
    (lambda d: d.replace(b"data\n", b"dada\n"), "header has no end"),
    (lambda d: d.replace(b"size", b"seize"), "header is damaged"),
    (lambda d: d.replace(b"res 0.2", b"res zero"), "header is damaged"),
    (lambda d: d.replace(b"res 0.2", b"res nan"), "res nan"),
    (lambda d: d.replace(b"res 0.2", b"res -1"), "res -1"),
    (lambda d: d.replace(b"OcTree\nsize", b"CountingOcTree\nsize"), "CountingOcTree"),
    (lambda d: d.replace(b"size ", b"size 1"), "the header says"),
    (lambda d: d[:-1], "cut off"),
    (lambda d: d + b"\x00", "1 bytes follow"),
])  # fmt: skip
@pytest.mark.parametrize("write", [write_bt, write_ot])
def test_a_wrong_file_is_told(change, words, write):
    with pytest.raises(InputError, match=words) as told:
        read_octomap(change(write(random_map(1))), file="map.bt")
    assert str(told.value).startswith("map.bt: ")


def test_a_value_that_is_no_number_and_a_node_below_the_voxels_are_told():
    with pytest.raises(InputError, match="no number"):
        read_octomap(leaf_file(16, 17)[:-5] + struct.pack("<f", math.nan) + b"\x00")
    with pytest.raises(InputError, match="below the voxels"):
        read_octomap(leaf_file(17, 18))
    head = leaf_file(0, 99)[:-5].replace(b"# Octomap OcTree file", b"# Octomap OcTree binary file")
    with pytest.raises(InputError, match="below the voxels"):
        read_octomap(head + b"\x03\x00" * 99)


@settings(max_examples=200, deadline=None)
@given(seed=st.integers(0, 3), write=st.sampled_from([write_bt, write_ot]), data=st.data())
def test_flipped_bytes_and_cuts_give_a_map_or_an_error_that_says_why(seed, write, data):
    whole = bytearray(write(random_map(seed, blocks=2)))
    for _ in range(data.draw(st.integers(1, 4))):
        whole[data.draw(st.integers(0, len(whole) - 1))] = data.draw(st.integers(0, 255))
    cut = data.draw(st.integers(0, len(whole)))
    with suppress(InputError):
        read_octomap(bytes(whole[:cut]), most_blocks=1000)


def test_morton_codes_are_those_of_bits_put_in_turn():
    rng = np.random.default_rng(0)
    xyz = rng.integers(0, 1 << 21, (500, 3))
    codes = interleave(xyz)
    brute = [sum(((int(p[a]) >> b) & 1) << (3 * b + a) for a in range(3) for b in range(21)) for p in xyz]
    assert codes.tolist() == brute
    assert np.array_equal(deinterleave(codes), xyz)
    x, y, z = deinterleave(np.arange(512)).T
    assert np.array_equal(cells_in_order(), 64 * x + 8 * y + z)


def test_leaves_of_all_depths_fill_their_voxels():
    """Against filling a dense box voxel by voxel."""
    origin = 4096 * 8
    code = interleave(
        np.array([[origin, origin, origin], [origin + 16, origin, origin], [origin + 20, origin + 4, origin]])
    )
    depth, value = np.array([12, 15, 14], np.uint8), np.array([3, -2, 7], np.int8)
    xyz, log_odds = blocks_of(code, depth, value, 100)
    dense = np.full((24, 16, 16), UNKNOWN)
    dense[:16] = 3
    dense[16:18, :2, :2] = -2
    dense[20:24, 4:8, :4] = 7
    for place, cells in zip(xyz, log_odds, strict=True):
        x, y, z = 8 * place
        assert np.array_equal(cells.reshape(8, 8, 8), dense[x : x + 8, y : y + 8, z : z + 8])
    assert len(xyz) == 8 + 1
