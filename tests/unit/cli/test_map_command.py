"""`companion map`: the documented commands, and wrong input."""

import json
import re
import shlex
from pathlib import Path

import numpy as np
import pytest
import yaml
from typer.testing import CliRunner

from companion.cli.main import app, main
from companion.mapping.formats.stored_map import StoredMap
from companion.mapping.sensor_model import quantise
from companion.runtime.map_file import read_map, write_map
from tests.unit.mapping.random_maps import OURS, classes, same

ROOT = Path(__file__).resolve().parents[3]
COMMANDS = re.findall(r"^\.venv/bin/companion (map .*)$", (ROOT / "docs/maps.md").read_text(), re.MULTILINE)


def plot():
    """Flat ground of 8 x 8 x 3 m, a trunk in it, free space above."""
    steps = quantise(OURS)
    corners = np.indices((5, 5, 2)).reshape(3, -1).T
    dense = np.full((40, 40, 16), steps.lowest, np.int8)
    dense[:, :, 0] = steps.highest
    dense[12, 30] = steps.highest
    cells = [dense[8 * i : 8 * i + 8, 8 * j : 8 * j + 8, 8 * k : 8 * k + 8].reshape(-1) for i, j, k in corners]
    return StoredMap(0.2, OURS, corners.astype(np.int32), np.array(cells), created_by="a test")


@pytest.fixture
def folder(tmp_path, monkeypatch):
    (tmp_path / "flights/demo").mkdir(parents=True)
    write_map(tmp_path / "flights/demo/map.umap", plot())
    monkeypatch.chdir(tmp_path)
    return tmp_path


def run(command, code=0):
    result = CliRunner().invoke(app, shlex.split(command))
    assert result.exit_code == code, result.output
    return result.output


def test_the_documented_commands_end_well_one_after_the_other(folder):
    assert {command.split()[1] for command in COMMANDS} == {"info", "convert", "slice", "view"}
    for command in COMMANDS:
        run(command)
    assert {p.name for p in folder.iterdir()} == {
        "flights", "demo_map.jpg", "forest.bt", "forest.umap", "forest.ply", "forest.pgm", "forest.yaml", "forest.png",
    }  # fmt: skip
    assert same(read_map(folder / "forest.umap"), classes(plot()))
    facts = yaml.safe_load((folder / "forest.yaml").read_text())
    assert (facts["image"], facts["resolution"], facts["origin"]) == ("forest.pgm", 0.2, [0.0, 0.0, 0.0])
    pixels = np.frombuffer((folder / "forest.pgm").read_bytes()[-1600:], np.uint8).reshape(40, 40)[::-1].T
    assert np.argwhere(pixels < 128).tolist() == [[12, 30]]  # the trunk, and no ground


def test_info_tells_the_volumes_and_that_the_file_is_whole(folder):
    facts = json.loads(run("map info flights/demo --json"))
    occupied = 40 * 40 + 15
    assert facts["checksum"] == "ok"
    assert facts["occupied_voxels"] == occupied
    assert facts["free_voxels"] == 40 * 40 * 16 - occupied
    assert facts["known_m3"] == pytest.approx(8.0 * 8.0 * 3.2)
    assert facts["occupied_m3"] == pytest.approx(occupied * 0.008)
    assert (facts["low_m"], facts["high_m"]) == ([0.0, 0.0, 0.0], [8.0, 8.0, 3.2])
    assert facts["bytes"] == (folder / "flights/demo/map.umap").stat().st_size
    assert facts["created_by"] == "a test"
    text = run("map info flights/demo")
    assert "x 0.0 to 8.0 m, y 0.0 to 8.0 m, z 0.0 to 3.2 m" in text
    assert "1,615 voxels" in text


def test_scale_is_an_image_with_transparency(folder):
    run("map slice flights/demo --z 1.3 --mode scale --out layer")
    assert (folder / "layer.png").read_bytes()[:4] == b"\x89PNG"
    assert yaml.safe_load((folder / "layer.yaml").read_text())["image"] == "layer.png"
    assert (folder / "layer_picture.png").exists()


@pytest.mark.parametrize("command, words", [
    ("info none.umap", "none.umap: No such file"),
    ("info .", "map.umap: No such file"),
    ("info broken.umap", "broken.umap: damaged"),
    ("info other.umap", "other.umap: no .umap"),
    ("info other.bt", "other.bt: no OctoMap"),
    ("convert flights/demo forest.xyz", "valid: .umap, .bt, .ot, .ply, .pcd"),
    ("convert flights/demo no/forest.bt", "no/forest.bt: No such file"),
    ("slice flights/demo --out s", "--z Z [--band B], or --from A --to B"),
    ("slice flights/demo --out s --z 1 --from 0", "--z Z [--band B], or --from A --to B"),
    ("slice flights/demo --out s --z 1 --band -1", "--band: -1.0 m"),
    ("slice flights/demo --out s --z nan", "no band"),
    ("slice flights/demo --out s --z 99", "nothing is known"),
    ("slice flights/demo --out s --from 2 --to 1", "no band"),
    ("slice flights/demo --out s --z 1 --mode grey", "valid: trinary, scale, raw"),
    ("slice flights/demo --out no/s --z 1", "no/s.pgm: No such file"),
    ("view flights/demo --out map.gif", "valid: .png, .jpg, .svg, .pdf"),
    ("view flights/demo --out no/map.png", "no/map.png: No such file"),
])  # fmt: skip
def test_wrong_input_ends_with_2_and_says_what_and_where(command, words, folder, monkeypatch, capsys):
    whole = (folder / "flights/demo/map.umap").read_bytes()
    (folder / "broken.umap").write_bytes(whole[:-40] + bytes([whole[-40] ^ 1]) + whole[-39:])
    (folder / "other.umap").write_text("no map")
    (folder / "other.bt").write_text("no map")
    monkeypatch.setattr("sys.argv", ["companion", "map", *shlex.split(command)])
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 2
    told = capsys.readouterr().err
    assert words in told
    assert "Traceback" not in told
    assert not list(folder.glob("*.part"))
