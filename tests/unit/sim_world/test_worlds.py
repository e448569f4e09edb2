"""Stands obey the laws of their figures; measured maps load as they are; errors say what is valid."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree

from companion.core.errors import InputError
from sim.sensors.caster import Caster
from sim.world import load_world
from sim.world.mesh import BRANCH, GROUND, LEAF
from sim.world.model import BRANCH_CONE, TRUNK_CONE
from sim.world.spec import PoissonSpec
from sim.world.stand import scatter
from sim.world.world import WORLDS_DIR

DATA = Path(__file__).resolve().parents[4] / "shared" / "data"
needs_data = pytest.mark.skipif(not DATA.is_dir(), reason="the shared real data are not here")
RIOJA = f"stems:{DATA}/forest_rioja_field_plots/tree_field.csv"


def positions(world):
    return np.column_stack([world.stems.x, world.stems.y])


def rays_down(xy, height_m):
    down = np.tile([0.0, 0.0, -1.0], (len(xy), 1))
    return np.column_stack([xy, np.full(len(xy), height_m), down]).astype(np.float32)


@pytest.mark.parametrize("stems_per_ha", [100, 400, 1200])
def test_the_number_of_stems_is_poisson_about_the_density(stems_per_ha):
    spec = PoissonSpec(stems_per_ha=stems_per_ha)
    counts = [len(scatter(spec, np.random.default_rng(seed))) for seed in range(12)]
    expected = stems_per_ha * 1.44
    assert abs(np.mean(counts) - expected) < 4 * np.sqrt(expected / 12)
    assert 0.2 < np.var(counts, ddof=1) / expected < 3.0  # a Poisson count's variance is its mean


def test_stems_keep_their_distance_and_without_a_core_do_not():
    dense = {"stems_per_ha": 1500, "leaves": 0, "cell_m": 5.0}
    apart = load_world("poisson", seed=1, options={**dense, "min_spacing_m": 1.8})
    free = load_world("poisson", seed=1, options={**dense, "min_spacing_m": 0.0})
    assert cKDTree(positions(apart)).query(positions(apart), k=2)[0][:, 1].min() >= 1.8
    gaps = cKDTree(positions(free)).query(positions(free), k=2)[0][:, 1]
    expected = 1 - np.exp(-np.pi * 0.15)  # a Poisson process's nearest neighbour within 1 m
    assert abs(np.mean(gaps < 1.0) - expected) < 0.05


def test_diameters_and_heights_follow_their_curves():
    world = load_world("poisson", seed=2, options={"stems_per_ha": 1500, "dbh_mean_m": 0.3, "leaves": 0})
    stems = world.stems
    assert abs(stems.dbh_m.mean() - 0.3) < 0.01
    assert abs(stems.dbh_m.std() - 0.08) < 0.01
    curve = 1.3 + 27.7 * (1 - np.exp(-3 * stems.dbh_m))
    assert abs((stems.height_m / curve).mean() - 1) < 0.01


def test_the_diameter_of_a_trunk_is_the_one_at_breast_height():
    world = load_world("poisson", seed=2)
    trunks = world.cones[world.kinds == TRUNK_CONE]
    along = 0.3 + 1.3  # the base is 0.3 m below ground
    radius = trunks[:, 7] + (trunks[:, 8] - trunks[:, 7]) * along / trunks[:, 6]
    np.testing.assert_allclose(2 * radius, world.stems.dbh_m, rtol=1e-9)
    at_ground = trunks[:, :3] + 0.3 * trunks[:, 3:6]
    np.testing.assert_allclose(at_ground, np.column_stack([positions(world), world.stems.z_ground]))


def test_the_start_is_the_origin_on_the_ground_and_free():
    for seed in range(3):
        options = {"branches": 20, "clearing_m": 3.0, "slope_deg": 10.0}
        world = load_world("poisson", seed=seed, options=options)
        assert world.ground_z(0.0, 0.0) == 0.0
        assert (np.hypot(world.stems.x, world.stems.y) - world.stems.dbh_m / 2).min() >= 3.0
        branches = world.cones[world.kinds == BRANCH_CONE]
        along = np.linspace(0, 1, 20)[:, None, None] * branches[:, 6:7]
        points = branches[:, :2] + along * branches[:, 3:5]
        assert np.linalg.norm(points, axis=2).min() >= 3.0 - 1e-9


def test_branches_have_the_asked_number_size_and_height():
    asked = {
        "branches": 20,
        "branch_diameter_m": [0.01, 0.02],
        "branch_length_m": [0.4, 0.9],
        "lean_deg": 0.0,
    }
    world = load_world("poisson", seed=3, options={**asked, "branch_height_m": [1.0, 5.0], "roughness_m": 0.0})
    branches = world.cones[world.kinds == BRANCH_CONE]
    assert len(branches) > 0.97 * 20 * len(world.stems)  # those over the start are cut
    assert branches[:, 7].min() >= 0.005
    assert branches[:, 7].max() <= 0.01
    assert branches[:, 6].min() >= 0.4
    assert branches[:, 6].max() <= 0.9
    assert branches[:, 2].min() >= 1.0
    assert branches[:, 2].max() <= 5.0
    assert np.count_nonzero(world.mesh.classes == BRANCH) == 8 * len(branches)


def test_crowns_stay_above_their_base():
    world = load_world("poisson", seed=3, options={"roughness_m": 0.0, "lean_deg": 0.0, "crown_base_m": 7.0})
    leaves = world.mesh.triangles[world.mesh.classes == LEAF]
    center_z = world.mesh.vertices[leaves, 2].mean(axis=1)
    assert center_z.min() > 7.0
    assert len(leaves) == 100 * np.count_nonzero(world.stems.height_m > 8.0)


def test_a_world_is_its_seed_and_more_branches_move_no_tree():
    one, again = load_world("demo", seed=1), load_world("demo", seed=2)
    np.testing.assert_array_equal(one.mesh.vertices, again.mesh.vertices)  # the demo fixes its seed
    bare, branchy = load_world("poisson,branches=0", seed=5), load_world("poisson,branches=9", seed=5)
    np.testing.assert_array_equal(bare.stems.x, branchy.stems.x)
    np.testing.assert_array_equal(bare.heights, branchy.heights)
    assert not np.array_equal(bare.stems.x[:50], load_world("poisson", seed=6).stems.x[:50])


def test_ground_height_is_the_height_of_the_triangles():
    world = load_world("empty", seed=1, options={"slope_deg": 8.0, "roughness_m": 0.5})
    xy = np.random.default_rng(0).uniform(-60, 60, (500, 2))
    far, ids = Caster(world.mesh).cast(rays_down(xy, 50.0))
    np.testing.assert_allclose(world.ground_z(*xy.T), 50.0 - far, atol=2e-5)
    assert np.all(world.mesh.classes[ids] == GROUND)


def test_slope_and_roughness_are_the_asked_ones():
    options = {"slope_deg": 10.0, "slope_heading_deg": 90.0, "roughness_m": 0.2}
    world = load_world("empty", seed=4, options=options)
    x, y = np.meshgrid(np.arange(-50, 51, 1.0), np.arange(-50, 51, 1.0), indexing="ij")
    z = world.ground_z(x, y)
    plane = np.column_stack([x.ravel(), y.ravel(), np.ones(x.size)])
    fit, *_ = np.linalg.lstsq(plane, z.ravel(), rcond=None)
    assert abs(fit[1] - np.tan(np.radians(10))) < 0.01
    assert abs(fit[0]) < 0.01
    assert abs((z.ravel() - plane @ fit).std() - 0.2) < 0.04


@needs_data
@pytest.mark.parametrize(("file", "count", "mean_dbh_m"), [("longleaf", 584, 0.2684), ("spruces", 134, 0.2504)])
def test_real_stem_maps_load_whole(file, count, mean_dbh_m):
    path = DATA / "forest_stem_maps" / f"{file}.csv"
    world = load_world(f"stems:{path}", seed=0)
    assert len(world.stems) == count
    assert abs(world.stems.dbh_m.mean() - mean_dbh_m) < 1e-3
    table = np.loadtxt(path, delimiter=",", skiprows=1)
    shift = table[:, :2] - positions(world)
    np.testing.assert_allclose(shift, np.broadcast_to(shift[0], shift.shape), atol=1e-9)
    assert (np.hypot(world.stems.x, world.stems.y) - world.stems.dbh_m / 2).min() >= 2.0


@needs_data
def test_a_plot_of_the_rioja_inventory_has_its_field_heights():
    world = load_world(f"{RIOJA},unit=cm,plot=3,branches=12", seed=0)
    assert len(world.stems) == 46
    assert 0.05 < world.stems.dbh_m.min() < world.stems.dbh_m.max() < 0.8
    first = np.argmin(abs(world.stems.dbh_m - 0.308))
    assert 5.0 < world.stems.height_m[first] < 25.0
    assert np.count_nonzero(world.kinds == BRANCH_CONE) > 400


@needs_data
@pytest.mark.parametrize(
    ("value", "field", "valid"),
    [
        (f"{RIOJA},unit=cm", "plot", "1, 2, 3, 4, 5, 6, 7, 8, 9, 10"),
        (f"{RIOJA},unit=cm,plot=77", "plot", "1, 2, 3, 4, 5, 6, 7, 8, 9, 10"),
        (f"{RIOJA},plot=1", "unit", "cm, m"),
        (f"{RIOJA},plot=1,unit=inch", "unit", "cm, m"),
        (f"{RIOJA},plot=1,unit=cm,clearing_m=9", "clearing_m", "at most"),
        (f"{RIOJA},plot=1,unit=cm,start_m=99/0", "start_m", "x -"),
        (f"stems:{DATA}/forest_stem_maps/spruces.csv,unit=cm", "unit", "m"),
    ],
)
def test_errors_of_stem_maps(value, field, valid):
    with pytest.raises(InputError) as caught:
        load_world(value, seed=0)
    assert caught.value.field == field
    assert valid in caught.value.valid


@pytest.mark.parametrize(
    ("value", "field", "valid"),
    [
        ("jungle", "world", "clearing, demo, empty, longleaf-style, mine, moving, poisson, warehouse"),
        ("poisson,trees=3", "trees", "stems_per_ha"),
        ("poisson,stems_per_ha=many", "stems_per_ha", ""),
        ("poisson,stems_per_ha=-1", "stems_per_ha", ""),
        ("poisson,stems_per_ha=4000,min_spacing_m=3", "stems_per_ha", "at most 707"),
        ("poisson,branch_height_m=5/2", "branch_height_m", "low, high"),
        ("poisson,kind=jungle", "kind", "empty, poisson, stems, warehouse, mine"),
        ("poisson,dense", "world", "key=value"),
        ("stems:/nowhere.csv", "stems", "a CSV file"),
    ],
)
def test_errors_name_the_field_and_the_choices(value, field, valid):
    with pytest.raises(InputError) as caught:
        load_world(value, seed=0)
    assert caught.value.field == field
    assert valid in caught.value.valid


def test_errors_of_csv_files_name_the_line(tmp_path):
    file = tmp_path / "a.csv"
    file.write_text("x_m,y_m,dbh_cm\n1,2,30\n3,oak,20\n")
    with pytest.raises(InputError, match=r"a\.csv:3: y_m: 'oak'"):
        load_world(f"stems:{file}", seed=0)
    file.write_text("east,y_m,dbh_cm\n1,2,30\n")
    with pytest.raises(InputError, match="x_m: no such column"):
        load_world(f"stems:{file}", seed=0)


def test_a_yaml_file_may_name_a_stem_map_beside_it(tmp_path):
    (tmp_path / "a.csv").write_text("x_m,y_m,dbh_m,h_m\n0,0,0.3,\n10,0,0.2,11\n0,10,0.25,12\n9,9,0.4,20\n")
    (tmp_path / "w.yaml").write_text("kind: stems\nfile: a.csv\nheight_sd: 0\n")
    world = load_world(str(tmp_path / "w.yaml"), seed=0)
    np.testing.assert_allclose(world.stems.height_m, [1.3 + 27.7 * (1 - np.exp(-0.9)), 11, 12, 20])
    (tmp_path / "w.yaml").write_text("kind: [\n")
    with pytest.raises(InputError, match=r"w\.yaml:\d"):
        load_world(str(tmp_path / "w.yaml"), seed=0)


@pytest.mark.parametrize("file", sorted(WORLDS_DIR.glob("*.yaml")), ids=lambda file: file.stem)
def test_every_world_of_ours_loads_by_name_and_starts_free(file):
    world = load_world(file.stem, seed=3)
    assert world.name == file.stem
    above_m = 2.0 if len(world.walls) else 30.0  # halls and mines have roofs
    down = np.array([0.0, 0.0, -1.0])
    assert world.range_to_surface(np.array([0.0, 0.0, above_m]), down) == pytest.approx(above_m, abs=0.01)
    assert all(value.flags.writeable is False for value in (world.cones, world.heights, world.mesh.vertices))


def test_a_slope_keeps_the_bounds_around_the_start():
    world = load_world("poisson", seed=3, options={"slope_deg": 20.0, "size_m": 60.0})
    x_min, y_min, x_max, y_max = world.bounds
    assert (x_max - x_min, y_max - y_min) == (60.0, 60.0)
    assert world.stems.x.min() >= x_min
    assert world.stems.y.max() <= y_max
    rise = world.ground_z(10.0, 0.0) - world.ground_z(-10.0, 0.0)
    assert rise == pytest.approx(20 * np.tan(np.radians(20)), abs=0.8)


def test_felling_takes_trees_and_moves_none():
    whole = load_world("poisson", seed=4, options={"branches": 3})
    thinned = load_world("poisson", seed=4, options={"branches": 3, "felled": 0.1})
    left = {tuple(p) for p in positions(thinned)}
    assert left < {tuple(p) for p in positions(whole)}
    assert 0.85 < len(left) / len(whole.stems) < 0.95
    share = {kind: np.sum(thinned.mesh.classes == kind) / np.sum(whole.mesh.classes == kind) for kind in range(4)}
    assert share[GROUND] == 1.0
    assert all(share[kind] == pytest.approx(len(left) / len(whole.stems), abs=0.03) for kind in (BRANCH, LEAF))
