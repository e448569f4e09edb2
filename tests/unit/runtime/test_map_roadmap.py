"""Ways through saved maps: the space against brute force, the roadmap in the file, the commands."""

import json
from dataclasses import replace

import numpy as np
import pytest
from typer.testing import CliRunner

from companion.cli.main import build
from companion.core.errors import InputError
from companion.mapping.formats.stored_map import StoredMap
from companion.mapping.formats.umap import pack, unpack
from companion.mapping.sensor_model import UNKNOWN, SensorModel
from companion.planning.polyline import length
from companion.runtime.map_file import write_map
from companion.runtime.map_roadmap import roadmap_of, whole_space, with_roadmap

RESOLUTION_M, CORNER = 0.2, np.array([-3, 2, 0])  # of the block that is lowest on all axes


@pytest.fixture(scope="module")
def wood():
    """96 x 64 x 16 cells: pillars, a wall with a gap, and a corner that was never seen."""
    state = np.full((96, 64, 16), -40, np.int8)
    for i, j in np.random.default_rng(3).integers(2, 60, (25, 2)):
        state[i : i + 2, j : j + 2] = 60
    state[48:50, :52] = 60
    state[80:, 48:] = UNKNOWN
    blocks = state.reshape(12, 8, 8, 8, 2, 8).transpose(0, 2, 4, 1, 3, 5).reshape(-1, 512)
    xyz = np.argwhere(np.ones((12, 8, 2), bool)).astype(np.int32) + CORNER.astype(np.int32)
    stored = StoredMap(resolution_m=RESOLUTION_M, sensor=SensorModel(), block_xyz=xyz, log_odds=blocks)
    return stored.canonical(), state


ENDS = CORNER * 8 * RESOLUTION_M + np.array([[1.1, 4.1, 1.7], [18.1, 4.3, 1.5]])


def test_the_space_is_the_known_free_cells_far_enough_from_occupied_ones(wood):
    stored, state = wood
    space = whole_space(stored, radius_m=0.5)
    corner = CORNER * 8 * RESOLUTION_M
    occupied = np.argwhere(state >= 0)
    rng = np.random.default_rng(0)
    for cell in rng.integers(0, state.shape, (400, 3)):
        gap_m = (np.linalg.norm(occupied - cell, axis=1).min() - 0.5) * RESOLUTION_M
        if state[tuple(cell)] == UNKNOWN or abs(gap_m - 0.5) > 1e-3:
            free = state[tuple(cell)] != UNKNOWN and gap_m >= 0.5
            assert space.free((corner + (cell + 0.5) * RESOLUTION_M)[None])[0] == free


def test_a_way_comes_out_of_the_file_as_it_went_in(wood):
    stored, _ = wood
    space = whole_space(stored, radius_m=0.5)
    kept = with_roadmap(replace(stored, sections={"other": b"kept"}), space, samples=600, seed=4)
    again = unpack(pack(kept))
    assert again.sections["other"] == b"kept"
    plans = [roadmap_of(m).query(*ENDS, space) for m in (kept, again)]
    assert plans[0].solved and np.array_equal(plans[0].path, plans[1].path)
    assert space.path_free(plans[0].path)
    straight = float(np.linalg.norm(ENDS[1] - ENDS[0]))
    assert straight < length(plans[0].path) < 2.0 * straight  # around the wall


def test_a_wider_vehicle_asks_the_same_roadmap_and_stays_free(wood):
    stored, _ = wood
    kept = with_roadmap(stored, whole_space(stored, radius_m=0.3), samples=1500, seed=1)
    wide = whole_space(stored, radius_m=0.7)
    plan = roadmap_of(kept).query(*ENDS, wide)
    assert plan.solved and wide.path_free(plan.path)


def test_maps_without_a_roadmap_without_blocks_or_too_wide_are_refused(wood):
    stored, _ = wood
    with pytest.raises(InputError, match="companion map roadmap"):
        roadmap_of(stored)
    empty = replace(stored, block_xyz=stored.block_xyz[:0], log_odds=stored.log_odds[:0])
    with pytest.raises(InputError, match="empty"):
        whole_space(empty, radius_m=0.5)
    far = stored.block_xyz[:2].copy()
    far[1] += 5000
    with pytest.raises(InputError, match="too many"):
        whole_space(replace(stored, block_xyz=far, log_odds=stored.log_odds[:2]), radius_m=0.5)


def run(*words):
    return CliRunner().invoke(build(["map"]), ["map", *words])


def test_the_commands(wood, tmp_path):
    file = tmp_path / "wood.umap"
    write_map(file, wood[0])
    ends = ["--from", ",".join(map(str, ENDS[0])), "--to", ",".join(map(str, ENDS[1]))]
    missing = run("route", str(file), *ends)
    assert isinstance(missing.exception, InputError)
    made = run("roadmap", str(file), "--samples", "800", "--clearance", "0.2")
    assert made.exit_code == 0 and "800 places" in made.stdout
    asked = run("route", str(file), *ends, "--clearance", "0.2", "--json")
    way = json.loads(asked.stdout)
    assert asked.exit_code == 0 and way["solved"] and way["places"] == 800
    assert way["length_m"] == pytest.approx(length(np.array(way["path"])), abs=0.02)
    for words in (
        ("--from", "1,2", "--to", "1,2,3"),
        ("--from", "1,2,x", "--to", "1,2,3"),
        ("--from", "99,0,0", *ends[2:]),
    ):
        wrong = run("route", str(file), *words)
        assert isinstance(wrong.exception, InputError) and wrong.exception.exit_code == 2
    assert isinstance(run("roadmap", str(tmp_path / "x.bt")).exception, InputError)
