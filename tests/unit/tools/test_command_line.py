"""The command line loads only what was asked for."""

import subprocess
import sys

import pytest

from companion.cli.main import COMMANDS, GROUPS, build

HEAVY = ("numba", "gtsam", "matplotlib", "open3d", "scipy", "cv2")


@pytest.mark.parametrize("word", ["topic", "node", "service", "top"])
def test_a_tool_of_the_bus_loads_no_algorithm_and_no_plotter(word):
    code = (
        "import sys; from companion.cli.main import build; "
        f"build([{word!r}, 'list']); print([m for m in {HEAVY!r} if m in sys.modules])"
    )
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stdout == "[]\n"


def test_without_a_known_word_everything_is_there():
    whole = build(["--help"])
    assert {c.name for c in whole.registered_commands} == set(COMMANDS)
    assert {g.name for g in whole.registered_groups} == set(GROUPS)
    one = build(["topic", "list"])
    assert [g.name for g in one.registered_groups] == ["topic"]
    assert one.registered_commands == []


def test_every_command_shows_an_example():
    whole = build()
    callbacks = [c.callback for c in whole.registered_commands]
    callbacks += [c.callback for g in whole.registered_groups for c in g.typer_instance.registered_commands]
    assert [c.__name__ for c in callbacks if "Example: companion " not in (c.__doc__ or "")] == []
