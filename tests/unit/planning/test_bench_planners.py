"""The comparison of planners and the exercise: what they print is what was found."""

import json
import math

import numpy as np
import pytest
from typer.testing import CliRunner

from companion.cli.main import build
from companion.core.errors import InputError
from companion.planning.registry import PLANNERS
from companion.runtime.bench.planners import bench_planners
from companion.runtime.bench.planners_exercise import GRID, comment, read_grid, solve
from companion.runtime.bench.planners_facts import FACTS
from companion.runtime.bench.planners_worlds import make_world


@pytest.fixture(scope="module")
def answers():
    return {(a.neighbours, a.heuristic): a for a in solve()}


def test_pictures_show_the_way_and_what_was_expanded(answers):
    blocked = GRID.count("#")
    for a in answers.values():
        letters = "".join(a.picture.split())
        assert letters.count("#") == blocked and len(letters) == 100
        assert letters.count("*") == len(a.path) - 2  # S and G keep their letters
        steps = np.abs(np.diff(a.path, axis=0))
        assert steps.sum(axis=1).max() == (1 if a.neighbours == 4 else 2)
        assert np.sqrt(steps.sum(axis=1)).sum() == pytest.approx(a.cost, abs=1e-3)


def test_the_larger_bound_expands_fewer_cells_and_admissible_ones_are_exact(answers):
    for neighbours in (4, 8):
        m, c = answers[neighbours, "manhattan"], answers[neighbours, "chebyshev"]
        assert m.expanded < c.expanded <= c.dijkstra_expanded
        assert c.cost == c.optimum and (m.cost == m.optimum or not m.admissible)
    assert answers[4, "manhattan"].admissible and not answers[8, "manhattan"].admissible


def test_the_comment_holds_the_numbers(answers):
    text = comment(list(answers.values()))
    for a in answers.values():
        assert str(a.expanded) in text and f"{a.cost:g}" in text and f"{a.cpu_us:g}" in text
    share = 100 * (1 - answers[4, "manhattan"].expanded / answers[4, "chebyshev"].expanded)
    assert f"{share:.0f} % fewer" in text


def test_a_longer_way_and_no_way_are_said():
    """Manhattan with diagonals is drawn into the longer way here: found by trying random grids."""
    rng = np.random.default_rng(0)
    for _ in range(300):
        cells = np.where(rng.random((10, 10)) < 0.3, "#", ".")
        cells[0, 0], cells[9, 9] = "S", "G"
        found = solve("\n".join("".join(row) for row in cells))
        longer = [a for a in found if a.cost > a.optimum + 1e-6]
        assert all(not a.admissible for a in longer)
        if longer:
            assert "is longer than the shortest" in comment(found)
            break
    else:
        raise AssertionError("no grid where Manhattan errs")
    walled = GRID[:11] + "#" * 10 + GRID[21:]
    nothing = solve(walled)
    assert all(a.cost == math.inf for a in nothing) and "there is no way" in comment(nothing)


@pytest.mark.parametrize("text", ["", "S..\n..", "S.x\n..G", "...\n..G", "SS.\n..G"])
def test_grids_that_are_none_are_refused(text):
    with pytest.raises(InputError, match="grid"):
        read_grid(text)


def test_every_planner_has_its_facts():
    assert set(PLANNERS) <= set(FACTS)


def test_rows_in_the_plane():
    rows = {r.planner: r for r in bench_planners(["maze_2d"], ["dijkstra", "astar", "theta_star", "prm"], runs=1)}
    assert all(r.success == 1.0 and r.cost_ratio >= 1.0 for r in rows.values())
    assert rows["astar"].cost_ratio == pytest.approx(rows["dijkstra"].cost_ratio, rel=0.01)
    assert rows["theta_star"].cost_ratio < rows["astar"].cost_ratio
    assert rows["astar"].work < rows["dijkstra"].work
    assert rows["prm"].again_ms < rows["prm"].cpu_ms and rows["astar"].again_ms is None


def test_worlds_are_the_same_each_time_and_their_ends_are_joined():
    a, b = make_world("maze_2d"), make_world("maze_2d")
    assert np.array_equal(a.space.steps, b.space.steps) and np.array_equal(a.ends, b.ends)
    assert a.space.free(a.ends.reshape(-1, 3)).all() and a.plane
    with pytest.raises(InputError, match="maze_2d, forest, windows, maze"):
        make_world("atlantis")


def run(*words):
    return CliRunner().invoke(build(["bench"]), ["bench", "planners", *words])


def test_the_command_prints_json_lines_and_refuses_what_is_wrong(tmp_path):
    done = run("--exercise", "--json")
    lines = [json.loads(line) for line in done.stdout.splitlines()]
    assert done.exit_code == 0 and [line["neighbours"] for line in lines] == [4, 4, 8, 8]
    bad = tmp_path / "grid.txt"
    bad.write_text("S.\n.?")
    for words in (("--planner", "dstar"), ("--worlds", "moon"), ("--grid", str(bad)), ("--out", "/nowhere/x.jsonl")):
        result = run(*words)
        assert isinstance(result.exception, InputError) and result.exception.exit_code == 2
