"""`companion bench planners`: the textbook's planners on the same worlds, and its exercise."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.table import Table

from companion.cli.bench_rows import written
from companion.cli.bus_options import Json
from companion.core.errors import InputError
from companion.planning.registry import PLANNERS
from companion.runtime.bench.planners import PlannerRow, bench_planners
from companion.runtime.bench.planners_exercise import GRID, Answer, comment, solve
from companion.runtime.bench.planners_facts import FACTS
from companion.runtime.bench.planners_worlds import WORLDS, make_world

_PICTURED = "maze_2d"


def planners(
    worlds: Annotated[list[str] | None, typer.Option(help="This world; give it again for more. None: all.")] = None,
    only: Annotated[
        list[str] | None, typer.Option("--planner", help="This planner; again for more. None: all.")
    ] = None,
    runs: Annotated[int, typer.Option(min=1, max=100, help="Seeds per pair of ends, where samples are drawn.")] = 5,
    picture: Annotated[
        Path | None, typer.Option(help="Draw every planner's search and way in the plane maze, PNG.")
    ] = None,
    exercise: Annotated[bool, typer.Option("--exercise", help="The 10 x 10 grid instead, two heuristics.")] = False,
    grid: Annotated[Path | None, typer.Option(help="Another grid for the exercise: text of . # S G.")] = None,
    out: Annotated[Path | None, typer.Option(help="Write the rows there, too, one JSON object per line.")] = None,
    as_json: Json = False,
) -> None:
    """Compare all planners on the same worlds. Example: companion bench planners --worlds maze_2d --runs 3

    Optimality, completeness and effort as the textbooks have them, beside what was measured: share of runs that
    arrive, length over that of the shortest way known, CPU time. All worlds take about five minutes. JSON is
    also printed if standard output is no terminal.
    """
    for path in (out, picture):
        if path is not None and not path.parent.is_dir():
            raise InputError("no such folder", file=str(path.parent))
    console = Console()
    plain = as_json or not console.is_terminal
    if exercise or grid is not None:
        _exercise(console, grid, out, plain=plain)
        return
    asked = _known(only or list(PLANNERS), "--planner", list(PLANNERS))
    places = _known(worlds or list(WORLDS), "--worlds", list(WORLDS))
    done = list(written(bench_planners(places, asked, runs=runs, say=_progress), out=out, plain=plain))
    if not plain:
        console.print(facts_table(asked))
        for name in dict.fromkeys(row.world for row in done):
            console.print(world_table(name, [row for row in done if row.world == name]))
    if picture is not None:
        from companion.report.planners_picture import draw_planners

        draw_planners(make_world(_PICTURED), asked, picture)


def facts_table(names: list[str]) -> Table:
    """What the textbooks say."""
    table = Table(title="Planners, as the textbooks have them")
    for column in ("planner", "optimal", "complete", "effort", "use"):
        table.add_column(column)
    for name in names:
        if name in FACTS:
            facts = FACTS[name]
            table.add_row(name, facts.optimal, facts.complete, facts.effort, facts.use)
    return table


def world_table(world: str, rows: list[PlannerRow]) -> Table:
    """What was measured in one world."""
    table = Table(title=f"{WORLDS[world][0]}: length over that of the shortest way known, CPU time of one plan")
    for column in ("planner", "arrives", "length", "worst", "CPU ms", "work", "", "again, CPU ms"):
        table.add_column(column, justify="left" if column in ("planner", "") else "right")
    for row in rows:
        table.add_row(*cells(row))
    return table


def cells(row: PlannerRow) -> list[str]:
    """One text per column of `world_table`."""
    lengths = ["-" if ratio is None else f"{ratio:.3f}" for ratio in (row.cost_ratio, row.cost_ratio_worst)]
    again = "" if row.again_ms is None else f"{row.again_ms:.2f}"
    return [
        row.planner,
        f"{100 * row.success:.0f} %",
        *lengths,
        f"{row.cpu_ms:.0f}" if row.cpu_ms >= 100 else f"{row.cpu_ms:.3g}",
        f"{row.work:.0f}",
        row.unit,
        again,
    ]


def _exercise(console: Console, grid: Path | None, out: Path | None, *, plain: bool) -> None:
    answers = list(written(solve(_text(grid) if grid is not None else GRID), out=out, plain=plain))
    if not plain:
        console.print(exercise_table(answers))
        console.print(comment(answers), highlight=False)


def exercise_table(answers: list[Answer]) -> Table:
    """One column per heuristic and set of neighbours."""
    table = Table(title="A* on a grid of 10 x 10: * way, + expanded, # blocked")
    for a in answers:
        table.add_column(f"{a.heuristic}, {a.neighbours} neighbours")
    table.add_row(*(a.picture for a in answers))
    table.add_row(*(f"length {a.cost:g}\nexpanded {a.expanded}\nCPU {a.cpu_us:g} µs" for a in answers))
    return table


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError("cannot be read as text", file=str(path)) from error


def _known(names: list[str], option: str, valid: list[str]) -> list[str]:
    for name in names:
        if name not in valid:
            raise InputError(f"{name!r} is not there", field=option, valid=", ".join(valid))
    return names


def _progress(text: str) -> None:
    Console(stderr=True).print(text, style="dim", highlight=False)
