"""Map files on disk: formats by suffix, old flights, errors that name the file."""

import numpy as np
import pytest

from companion.core.errors import InputError
from companion.core.rig import Rig
from companion.mapping.node import MappingConfig, MappingNode
from companion.runtime.map_file import MAP_FILE, map_path, read_map, save_map, write_map
from tests.unit.mapping.random_maps import OCTOMAPS, classes, random_map, same


def test_each_format_comes_back(tmp_path):
    stored = random_map(4)
    for suffix, expected in ((".umap", stored), (".ot", stored), (".bt", classes(stored)), (".UMAP", stored)):
        size = write_map(tmp_path / f"map{suffix}", stored)
        assert size == (tmp_path / f"map{suffix}").stat().st_size
        assert same(read_map(tmp_path / f"map{suffix}"), expected)
    assert not list(tmp_path.glob("*.part"))
    theirs = random_map(4, sensor=OCTOMAPS)
    write_map(tmp_path / "theirs.ot", theirs)
    assert same(read_map(tmp_path / "theirs.ot", sensor=OCTOMAPS), theirs)


def npz_of(stored):
    model = stored.sensor
    return {
        "resolution_m": np.array(stored.resolution_m),
        "sensor_model": np.array([model.hit, model.miss, model.lowest, model.highest]),
        "block_xyz": stored.block_xyz,
        "log_odds": stored.log_odds,
    }


def test_a_folder_is_the_flight_in_it_old_or_new(tmp_path):
    stored = random_map(4)
    np.savez_compressed(tmp_path / "map.npz", **npz_of(stored))
    assert map_path(tmp_path).name == "map.npz"
    assert same(read_map(tmp_path), stored)
    write_map(tmp_path / MAP_FILE, random_map(5))
    assert same(read_map(tmp_path), random_map(5))


@pytest.mark.parametrize("name", ["none.umap", "none.bt", "map.xyz", "map", "no/where.umap"])
def test_what_cannot_be_read_is_named(name, tmp_path):
    with pytest.raises(InputError) as told:
        read_map(tmp_path / name)
    assert str(told.value).startswith(str(tmp_path / name))


@pytest.mark.parametrize("content", [b"", b"nothing", b"PK\x03\x04 broken"])
@pytest.mark.parametrize("suffix", [".umap", ".bt", ".ot", ".npz"])
def test_files_of_other_things_are_named(content, suffix, tmp_path):
    path = tmp_path / f"map{suffix}"
    path.write_bytes(content)
    with pytest.raises(InputError) as told:
        read_map(path)
    assert str(told.value).startswith(str(path))


def test_an_npz_that_is_no_map_is_named(tmp_path):
    stored = random_map(4)
    for key, value in (("log_odds", np.zeros((2, 3), np.int8)), ("sensor_model", np.zeros(4)), ("block_xyz", "a")):
        np.savez(tmp_path / "map.npz", **npz_of(stored) | {key: value})
        with pytest.raises(InputError) as told:
            read_map(tmp_path / "map.npz")
        assert str(told.value).startswith(str(tmp_path / "map.npz"))
    np.savez(tmp_path / "map.npz", a=np.zeros(3))
    with pytest.raises(InputError, match="no map of an old flight"):
        read_map(tmp_path / "map.npz")


def test_a_place_that_cannot_be_written_is_named_and_nothing_is_left(tmp_path):
    with pytest.raises(InputError, match="a place to write to"):
        write_map(tmp_path / "no" / "map.umap", random_map(4))
    (tmp_path / "map.umap").mkdir()
    with pytest.raises(InputError, match="a place to write to"):
        write_map(tmp_path / "map.umap", random_map(4))
    assert [p.name for p in tmp_path.iterdir()] == ["map.umap"]
    with pytest.raises(InputError, match=r"valid: \.umap, \.bt"):
        write_map(tmp_path / "map.npz", random_map(4))


def test_the_map_of_a_flight_is_saved(tmp_path):
    node = MappingNode(MappingConfig(), Rig(), hull_radius_m=0.3)
    points = np.random.default_rng(0).normal(size=(500, 3)).astype(np.float32) * 4
    node.voxels.insert(points, R_odom_body=np.eye(3), p_odom=np.zeros(3), origin_odom=np.zeros(3))
    save_map(tmp_path / MAP_FILE, [node])
    again = read_map(tmp_path)
    assert again.created_by.startswith("understory ")
    assert again.frame == "odom"
    living = again.to_voxels(MappingConfig().voxels)
    assert np.array_equal(living.query(points), node.voxels.query(points), equal_nan=True)
    save_map(tmp_path / "none.umap", [])
    assert not (tmp_path / "none.umap").exists()
