"""Our own map file: the same map, the same bytes; no damage goes unnoticed."""

import re
import struct
import zlib

import msgspec
import numpy as np
import pytest
import xxhash
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.core.errors import InputError
from companion.mapping.formats.stored_map import StoredMap, stored
from companion.mapping.formats.umap import MAGIC, Header, Section, pack, read_header, unpack
from companion.mapping.sensor_model import UNKNOWN
from companion.mapping.voxel_map import VoxelMap, VoxelMapConfig
from tests.unit.mapping.random_maps import OCTOMAPS, OURS, random_map, same

FEATURES = {"features": bytes(range(256)) * 5, "empty": b""}


def with_sections(plain, sections):
    return StoredMap(plain.resolution_m, plain.sensor, plain.block_xyz, plain.log_odds, "map", "a test", sections)


def sealed(header, *sections):
    """A file with a valid checksum, whatever it holds."""
    text = header if isinstance(header, bytes) else msgspec.json.encode(header)
    body = struct.pack("<8sII", MAGIC, 1, len(text)) + text + b"".join(sections)
    return body + xxhash.xxh3_128_digest(body)


def header_of(blocks, *sections):
    return Header(resolution_m=0.2, sensor=OURS, frame="odom", blocks=blocks, created_by="", sections=sections)


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 10_000))
def test_everything_comes_back(seed):
    written = with_sections(random_map(seed, sensor=OCTOMAPS, resolution_m=0.1), FEATURES)
    read = unpack(pack(written))
    assert same(read, written)
    assert (read.resolution_m, read.sensor, read.frame, read.created_by) == (0.1, OCTOMAPS, "map", "a test")
    assert read.sections == FEATURES


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 10_000))
def test_the_same_map_gives_the_same_bytes_in_any_order_of_blocks_and_sections(seed):
    one = with_sections(random_map(seed), FEATURES)
    order = np.random.default_rng(seed).permutation(len(one.block_xyz) + 1)
    xyz = np.concatenate([one.block_xyz, [[99, 0, 0]]]).astype(np.int32)[order]  # and a block without a known cell
    log_odds = np.concatenate([one.log_odds, np.full((1, 512), UNKNOWN, np.int8)])[order]
    turned = StoredMap(one.resolution_m, one.sensor, xyz, log_odds, "map", "a test", dict(reversed(FEATURES.items())))
    assert pack(turned) == pack(one)
    assert pack(unpack(pack(one))) == pack(one)


def test_every_flipped_byte_is_told():
    whole = pack(with_sections(random_map(0, blocks=1), FEATURES))
    for place in range(len(whole)):
        damaged = bytearray(whole)
        damaged[place] ^= 1 << (place % 8)
        with pytest.raises(InputError) as told:
            unpack(bytes(damaged), file="forest.umap")
        assert str(told.value).startswith("forest.umap: ")


def test_every_cut_is_told():
    whole = pack(random_map(0, blocks=1))
    for length in range(len(whole)):
        with pytest.raises(InputError, match=r"^forest.umap: (cut off|no .umap|damaged)"):
            unpack(whole[:length], file="forest.umap")
    with pytest.raises(InputError, match=re.escape(f"cut off: {len(whole) - 1:,} of {len(whole):,} bytes")):
        unpack(whole[:-1])
    with pytest.raises(InputError, match="damaged"):
        unpack(whole + b"\x00")


def test_another_version_and_another_file_are_told():
    whole = pack(random_map(0))
    with pytest.raises(InputError, match=r"version: format 2 \(valid: 1\)"):
        unpack(whole[:8] + struct.pack("<I", 2) + whole[12:])
    with pytest.raises(InputError, match=r"no \.umap"):
        unpack(whole.replace(b"\r\n", b"\n"))
    with pytest.raises(InputError, match=r"no \.umap"):
        unpack(b"")


def test_a_valid_checksum_does_not_excuse_nonsense():
    positions, cells = (zlib.compress(bytes(n)) for n in (12, 512))
    of = [Section(name="positions", size=12, stored=len(positions), needed=True),
          Section(name="log_odds", size=512, stored=len(cells), needed=True)]  # fmt: skip
    assert len(unpack(sealed(header_of(1, *of), positions, cells)).block_xyz) == 1
    bomb = zlib.compress(bytes(10_000_000))
    bombed = Section(name="log_odds", size=512, stored=len(bomb))
    for nonsense, words in (
        (sealed(b"{}"), "not of this format"),
        (sealed(b"\xff\xfe"), "no JSON"),
        (sealed(header_of(1, *of), positions), "do not fill"),
        (sealed(header_of(1, of[0]), positions), "missing"),
        (sealed(header_of(2, *of), positions, cells), "not 2 blocks"),
        (sealed(header_of(-1)), "less than no blocks"),
        (sealed(header_of(1, *of, of[0]), positions, cells, positions), "twice"),
        (sealed(header_of(1, *of), cells, positions), "do not fill|does not expand|cannot be expanded"),
        (sealed(header_of(1, of[0], Section(name="log_odds", size=512, stored=4)), positions, b"abcd"), "expanded"),
        (sealed(header_of(1, of[0], bombed), positions, bomb), "does not expand"),
        (sealed(header_of(10**9, *of), positions, cells), "up to 2,000,000"),
        (sealed(header_of(1, *of, Section(name="x", size=1 << 40, stored=0)), positions, cells), "up to"),
        (sealed(header_of(1, *of, Section(name="x", size=-1, stored=0)), positions, cells), "up to"),
        (sealed(header_of(1, *of, Section(name="bent", size=0, stored=0, needed=True)), positions, cells), "newer"),
    ):  # fmt: skip
        with pytest.raises(InputError, match=words):
            unpack(nonsense)


def test_a_block_twice_a_far_block_and_wrong_shapes_are_refused():
    cells = np.zeros((2, 512), np.int8)
    for xyz, log_odds, words in (
        (np.zeros((2, 3), np.int32), cells, "twice"),
        (np.array([[0, 0, 0], [1 << 20, 0, 0]], np.int32), cells, "too far"),
        (np.zeros((1, 3), np.int32), cells, "no map"),
        (np.zeros((2, 3), np.int32), cells.astype(np.int16), "no map"),
    ):
        with pytest.raises(InputError, match=words):
            pack(StoredMap(0.2, OURS, xyz, log_odds))
    with pytest.raises(InputError, match="resolution_m"):
        pack(StoredMap(float("nan"), OURS, np.zeros((2, 3), np.int32), cells))
    with pytest.raises(InputError, match="sections"):
        pack(with_sections(random_map(0), {"log_odds": b""}))


def test_an_empty_map_is_a_map():
    empty = StoredMap(0.2, OURS, np.empty((0, 3), np.int32), np.empty((0, 512), np.int8))
    assert same(unpack(pack(empty)), empty)


def test_progress_grows_to_one():
    many = random_map(0).canonical()
    xyz = np.concatenate([np.add(many.block_xyz, [10 * k, 0, 0]) for k in range(1000)]).astype(np.int32)
    large = StoredMap(0.2, OURS, xyz, np.tile(many.log_odds, (1000, 1)))
    told = []
    whole = pack(large, on_progress=told.append)
    assert told == sorted(told)
    assert told[-1] == 1.0
    assert len(told) > 3
    told.clear()
    assert same(unpack(whole, on_progress=told.append), large)
    assert told[-1] == 1.0


def test_the_header_says_what_is_inside():
    one = with_sections(random_map(0), FEATURES)
    header = read_header(pack(one))
    assert header.blocks == len(one.canonical().block_xyz)
    assert {s.name: s.size for s in header.sections if not s.needed} == {"features": 1280, "empty": 0}


def test_a_living_map_goes_into_the_file_and_lives_again():
    voxels = VoxelMap(VoxelMapConfig())
    rng = np.random.default_rng(0)
    points = rng.normal(size=(2000, 3)).astype(np.float32) * 5
    voxels.insert(points, R_odom_body=np.eye(3), p_odom=np.zeros(3), origin_odom=np.zeros(3))
    again = unpack(pack(stored(voxels, created_by="a test"))).to_voxels(VoxelMapConfig())
    probes = rng.uniform(-6, 6, (20_000, 3))
    assert np.array_equal(again.query(probes), voxels.query(probes), equal_nan=True)
    assert np.count_nonzero(again.classify(probes)) > 1000
    with pytest.raises(InputError, match="resolution_m"):
        unpack(pack(stored(voxels))).to_voxels(VoxelMapConfig(resolution_m=0.1))
