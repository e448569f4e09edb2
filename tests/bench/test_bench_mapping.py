"""The rows of `companion bench mapping` that a change of the map's code should look at, with few rounds.

`extra_info` holds the figures; `pytest tests/bench/test_bench_mapping.py --benchmark-json FILE` keeps them.
Bounds are far below what is measured (docs/reference/mapping.md): the machine may be busy.
"""

import msgspec
import numpy as np
import pytest

from companion.core.errors import InputError
from companion.mapping.voxel_map import VoxelMap
from companion.runtime.bench.mapping import ROWS, Options, bench_mapping
from companion.runtime.bench.mapping_correction import correction_figures
from companion.runtime.bench.mapping_forest import DENSE, fly, make_forest
from companion.runtime.bench.mapping_insert import agreement, like_octomap, time_insertion, time_threads
from companion.runtime.bench.mapping_peers import Prototype
from companion.runtime.bench.mapping_thin import thin_recall


@pytest.fixture(scope="module")
def scans():
    return list(fly(make_forest(DENSE, seed=1), "mid360", numbers=range(60, 63)))


@pytest.mark.slow
@pytest.mark.parametrize(("resolution_m", "times"), [(0.2, 60), (0.1, 50)])
def test_insertion_beside_octomap(benchmark, scans, resolution_m, times):
    figures = time_insertion(scans[:2], resolution_m, rounds=2)
    benchmark.extra_info.update(figures)
    voxels = VoxelMap(like_octomap(resolution_m))
    benchmark.pedantic(scans[0].into, args=(voxels,), rounds=5)
    assert figures["rounds"] == 2
    assert figures["peer_ms"] > times * figures["ours_ms"]


def test_distance_field_beside_scipy(benchmark):
    (row,) = benchmark.pedantic(lambda: list(bench_mapping(["field_scipy"], Options(rounds=1))), rounds=1)
    benchmark.extra_info.update(msgspec.to_builtins(row))
    assert row.figures["max_error_m"] == 0.0
    assert row.ratio is not None and row.ratio > 15


def test_two_threads_give_the_same_map(scans):
    assert time_threads(scans, 0.2, rounds=1)["same_map"] == 1.0


@pytest.mark.parametrize("ray_per", ["point", pytest.param("end_voxel", marks=pytest.mark.slow)])
def test_maps_of_a_few_scans_agree(scans, ray_per):
    found = agreement(scans[:1], 0.2, ray_per=ray_per)
    assert found["known_voxels"] > 500_000
    assert min(found[key] for key in ("agreement", "free_recall", "occupied_recall", "occupied_precision")) > 0.9998


@pytest.mark.slow
def test_a_corrected_way_moves_all_but_its_end_in_bounded_steps():
    found = correction_figures(length_m=100.0)
    assert found["moved"] >= 3
    assert 1 <= found["stayed"] <= found["moved"]
    assert found["steps"] >= found["moved"]


@pytest.mark.slow
def test_what_was_seen_of_branches_stands_in_the_map_although_most_scans_went_through():
    found = thin_recall("branches", "mid360", 0.2)
    assert found["seen_voxels"] > 200
    assert found["recall"] >= 0.95
    assert found["flown_recall"] >= 0.95
    assert found["octomap_flown_recall"] < found["flown_recall"] - 0.05  # or the world asks nothing of a map


def test_scans_of_the_forest_depend_on_their_number_alone(scans):
    again = list(fly(make_forest(DENSE, seed=1), "mid360", numbers=[62]))
    assert np.array_equal(again[0].points_body, scans[2].points_body)


def test_rows_that_do_not_exist_or_lack_their_data_say_so(tmp_path):
    with pytest.raises(InputError, match="no row 'x'"):
        list(bench_mapping(["x"], Options()))
    names = [name for name in ROWS if "hdl64" in name or "pair" in name]
    rows = list(bench_mapping(names, Options(data=tmp_path)))
    assert [row.name for row in rows] == names
    assert all("--data" in row.skipped and row.ours_ms is None for row in rows)


def test_another_map_from_a_file_takes_its_turn(tmp_path, scans):
    engine = tmp_path / "engine_of_a_test.py"
    engine.write_text(
        "class VoxMap:\n"
        "    def __init__(self, resolution_m, range_m):\n"
        "        assert (resolution_m, range_m) == (0.4, 30.0)\n"
        "    def insert(self, points_body, R_odom_body, p_odom):\n"
        "        assert points_body.shape[1:] == (3,) and R_odom_body.shape == (3, 3) and p_odom.shape == (3,)\n"
        "        sum(range(200_000))\n",
        encoding="utf-8",
    )
    figures = time_insertion(scans[:2], 0.4, rounds=1, prototype=Prototype(engine))
    assert figures["prototype_ms"] > 0.1
    assert figures["prototype_ratio"] == pytest.approx(figures["peer_ms"] / figures["prototype_ms"])
    for bad, text in ((tmp_path / "none.py", ""), (tmp_path / "no_map_in_it.py", "x = 1\n"), (tmp_path / "a.txt", "x")):
        if text:
            bad.write_text(text, encoding="utf-8")
        with pytest.raises(InputError, match="prototype"):
            Prototype(bad)
