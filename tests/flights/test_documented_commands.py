"""The commands that the README shows for one's own missions do what they say."""

import re
import shlex
from pathlib import Path

import pytest
from typer.testing import CliRunner

from companion.cli.main import app

ROOT = Path(__file__).resolve().parents[2]
COMMANDS = re.findall(r"^\.venv/bin/companion (.*)$", (ROOT / "README.md").read_text(), re.MULTILINE)
PLOT = "x,y,dbh_cm\n6,6,30\n-7,5,22\n12,-6,41\n-5,-8,18\n15,7,25\n"


def test_the_readme_shows_how_to_check_and_to_fly():
    assert {shlex.split(c)[0] for c in COMMANDS} >= {"mission", "fly"}


@pytest.mark.parametrize("command", COMMANDS)
def test_a_command_of_the_readme_ends_well(command, tmp_path, monkeypatch):
    (tmp_path / "missions").symlink_to(ROOT / "missions")
    (tmp_path / "my_plot.csv").write_text(PLOT)
    monkeypatch.chdir(tmp_path)
    result = CliRunner().invoke(app, shlex.split(command))
    assert result.exit_code == 0, result.output
