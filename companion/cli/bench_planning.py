"""`companion bench planning`: our planners beside OMPL's."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.table import Table

from companion.cli.bench_rows import check_out, written
from companion.cli.bus_options import Json
from companion.core.errors import InputError
from companion.runtime.bench.planning import ENCLOSED, PlanningOptions, bench_planning
from companion.runtime.bench.planning_rows import PlanningRow
from companion.runtime.bench.planning_worlds import PLANNING_WORLDS

_VALID = (*PLANNING_WORLDS, ENCLOSED)
_COLUMNS = ("world", "gauge", "planner", "value", "target", "met", "further figures")


def planning(
    worlds: Annotated[list[str] | None, typer.Option(help="This world; give it again for more. None: all.")] = None,
    runs: Annotated[int, typer.Option(min=1, max=1000, help="Runs per world and planner, over five pairs.")] = 25,
    peer_runs: Annotated[int, typer.Option(min=1, max=1000, help="Runs of OMPL's planners.")] = 10,
    data: Annotated[Path, typer.Option(help="Folder with map_octomap_share and map_bt_upo.")] = Path("data"),
    out: Annotated[Path | None, typer.Option(help="Write the rows there, too, one JSON object per line.")] = None,
    as_json: Json = False,
) -> None:
    r"""Measure our planners beside OMPL's on the same edges. Example: companion bench planning --worlds forest_25

    Planners take turns, run by run; times are CPU times. All worlds take about half an hour. OMPL comes with:
    pip install 'understory\[bench]'. JSON is also printed if standard output is no terminal.
    """
    for name in worlds or ():
        if name not in _VALID:
            raise InputError(f"{name!r} is no world", field="--worlds", valid=", ".join(_VALID))
    check_out(out)
    console = Console()
    plain = as_json or not console.is_terminal
    options = PlanningOptions(runs=runs, peer_runs=peer_runs, data=data)
    done = list(written(bench_planning(worlds or _VALID, options, say=_progress), out=out, plain=plain))
    if not plain:
        console.print(planning_table(done))


def planning_table(rows: list[PlanningRow]) -> Table:
    """The rows as people read them."""
    table = Table(title="Planners beside OMPL's: CPU ms, lengths over that of the shortest way known")
    for name in _COLUMNS:
        table.add_column(name, justify="right" if name in ("value", "target") else "left")
    for row in rows:
        table.add_row(*cells(row))
    return table


def cells(row: PlanningRow) -> list[str]:
    """One text per column."""
    met = "" if row.met is None else "yes" if row.met else "no"
    value = "never" if row.value is None and row.target is not None else "" if row.value is None else f"{row.value:g}"
    more = [f"{name} {'never' if x is None else format(x, 'g')}" for name, x in row.figures.items()]
    target = "" if row.target is None else f"{row.target:g}"
    return [row.world, row.gauge, row.planner, value, target, met, ", ".join([*more, row.note] if row.note else more)]


def _progress(text: str) -> None:
    Console(stderr=True).print(text, style="dim", highlight=False)
