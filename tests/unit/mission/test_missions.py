import json
import re
from pathlib import Path

import numpy as np
import pytest
import typer
import yaml
from typer.testing import CliRunner

from companion.cli import mission as cli
from companion.core.errors import InputError
from companion.mission import schema
from companion.mission.estimate import estimate, total_time_s, travel_time_s
from companion.mission.model import parse_mission
from companion.mission.route import legs_of

MISSIONS = sorted((Path(__file__).resolve().parents[3] / "missions").glob("*.yaml"))
README = MISSIONS[0].parent / "README.md"


def run(command, *arguments):
    app = typer.Typer()
    app.command()(command)
    return CliRunner().invoke(app, [str(a) for a in arguments])


@pytest.mark.parametrize("file", MISSIONS, ids=lambda f: f.stem)
def test_our_missions_can_be_flown_and_are_named_as_their_file(file):
    mission = parse_mission(file.read_text(), file=file.name)
    assert mission.name == file.stem and mission.description
    assert total_time_s(estimate(mission)) < mission.failsafe.time_limit_s


def test_the_demo_is_long_enough_and_stays_near_home():
    file = next(f for f in MISSIONS if f.stem == "first_flight")
    mission = parse_mission(file.read_text(), file=file.name)
    survey = next(row for row in estimate(mission) if row.do == "survey")
    assert survey.length_m >= 150
    assert np.all(np.abs([*survey.low[:2], *survey.high[:2]]) <= 20)


def test_the_readme_shows_the_table_of_today():
    result = run(cli.table, *MISSIONS)
    assert result.exit_code == 0
    assert result.stdout in README.read_text()


def test_the_readme_names_every_key_of_every_verb():
    text = README.read_text()
    common = set(schema.Step.__struct_fields__)
    for step in schema.Step.__subclasses__():
        row = next(r for r in text.splitlines() if r.startswith(f"| {step.__struct_config__.tag} |"))
        named = set(re.findall(r"[a-z_]+", re.sub(r"\(.*?\)", "", row.split("|")[2])))
        assert named == set(step.__struct_fields__) - common


def test_the_readme_example_is_a_mission():
    example = re.search(r"```yaml\n(.*?)```", README.read_text(), re.S)[1]
    assert parse_mission(example, file="README").name == "mine"


def test_check_prints_a_table_or_json():
    file = next(f for f in MISSIONS if f.stem == "hop")
    shown = run(cli.check, file)
    assert shown.exit_code == 0
    assert "takeoff_0" in shown.stdout and "10 m, 13 s, about 1% of the battery" in shown.stdout
    data = json.loads(run(cli.check, file, "--json").stdout)
    assert [s["do"] for s in data["steps"]] == ["takeoff", "goto", "land"]
    assert data["length_m"] == pytest.approx(10.0)
    assert run(cli.check, file, "--quiet").stdout == ""


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"version: 1\n", ":1: name: is missing"),
        (b"\xff\xfe\x00", "not UTF-8 text (valid: a YAML text file)"),
        (None, "No such file or directory (valid: a YAML text file)"),
    ],
)
def test_check_ends_wrong_files_with_exit_code_2(tmp_path, content, message):
    """The command raises a CompanionError; `companion.cli.main` prints its one line and exits."""
    file = tmp_path / "m.yaml"
    if content is not None:
        file.write_bytes(content)
    error = run(cli.check, file).exception
    assert isinstance(error, InputError) and error.exit_code == 2
    assert str(error).startswith(str(file)) and message in str(error)


@pytest.mark.parametrize(("length", "speed", "accel"), [(10, 2, 3), (0.5, 2, 3), (4 / 3, 2, 3), (0, 1, 1)])
def test_travel_time_is_that_of_an_integrated_trapezoid(length, speed, accel):
    t, v, x, dt = 0.0, 0.0, 0.0, 1e-4
    while x < length - 1e-9 and t < 60:
        braking = v * v / (2 * accel) >= length - x
        v = max(1e-4, v - accel * dt) if braking else min(speed, v + accel * dt)
        x, t = x + v * dt, t + dt
    assert travel_time_s(length, speed, accel) == pytest.approx(t, abs=0.02)


def test_limits_of_a_step_win_over_the_defaults():
    text = (
        "version: 1\nname: a\ndefaults: {speed: 3, agl: [1, 9]}\nsteps:\n  - {do: takeoff, alt: 2}\n"
        "  - {do: hover, seconds: 1, limits: {speed: 1}}\n  - {do: land}\n"
    )
    mission = parse_mission(text, file="a")
    assert [mission.limits_of(s).speed for s in mission.steps] == [3, 1, 3]
    assert [mission.limits_of(s).agl_max for s in mission.steps] == [9, 9, 9]
    assert mission.limits_of(mission.steps[1]).clearance == 0.4


def test_yaml_booleans_and_numbers_mean_what_other_readers_take_them_for():
    """Our number syntax is a subset of YAML's: PyYAML reads the same missions to the same values."""
    for file in MISSIONS:
        plain = yaml.safe_load(file.read_text())
        mission = parse_mission(file.read_text(), file=file.name)
        assert [s["do"] for s in plain["steps"]] == [s.__struct_config__.tag for s in mission.steps]
        for raw, step in zip(plain["steps"], mission.steps, strict=True):
            if "at" in raw:
                np.testing.assert_array_equal(legs_of(mission, step, (0.0, 0.0))[0].p, raw["at"])
