"""`companion mission upload|download` against a running `companion sim`."""

import json
import sys

import pytest

from companion.cli.main import main

pytest.importorskip("mavsdk", reason="MAVSDK is an extra: pip install 'understory[mavsdk]'")
MISSION = """
version: 1
name: around
steps:
  - {do: takeoff, alt: 3.0}
  - {do: goto, at: [6, 2, 4]}
  - {do: hover, seconds: 2}
  - {do: return_home, land: land}
"""


@pytest.fixture(scope="module")
def sim(start_sim):
    return start_sim("--gps", speed=2.0)


@pytest.fixture
def mission(sim, monkeypatch, capsys):
    """The command in this process; gives exit code, output and errors."""

    def run(*words):
        url = f"--vehicle=udpin://127.0.0.1:{sim.gcs}"
        monkeypatch.setattr(sys, "argv", ["companion", "mission", *words, url])
        with pytest.raises(SystemExit) as ended:
            main()
        out, error = capsys.readouterr()
        return ended.value.code, out.strip(), error.strip()

    return run


def test_a_mission_is_stored_and_read_back(mission, tmp_path):
    file = tmp_path / "around.yaml"
    file.write_text(MISSION)
    assert mission("download")[:2] == (0, "no mission is stored")
    code, out, error = mission("upload", str(file), "--origin=47.3977,8.5456,90")
    assert (code, error) == (0, "") and out.startswith("around: 5 items stored and read back")
    items = [json.loads(line) for line in mission("download", "--json")[1].splitlines()]
    assert [i["command"] for i in items] == [22, 178, 16, 93, 20]
    assert (items[2]["x"], items[2]["z"]) == (473_977_180, 4.0)  # two metres to the left of east is north


def test_what_has_no_place_on_earth_changes_nothing(mission, tmp_path):
    file = tmp_path / "body.yaml"
    file.write_text(MISSION.replace("4]}", "4], frame: body}"))
    code, _, error = mission("upload", str(file), "--origin=47.3977,8.5456,90")
    assert code == 2 and "goto_1.frame" in error
    code, _, error = mission("upload", str(file), "--origin=here")
    assert code == 2 and "LAT,LON,HEADING" in error
