"""`companion bench mapping`: the map beside its peers."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.table import Table

from companion.cli.bench_rows import check_out, written
from companion.cli.bus_options import Json
from companion.runtime.bench.mapping import MappingRow, Options, bench_mapping

_COLUMNS = (
    "row",
    "peer",
    "ours, CPU ms",
    "peer, CPU ms",
    "ratio",
    "rounds of each",
    "target",
    "aim",
    "further figures",
)


def mapping(
    rows: Annotated[
        list[str] | None, typer.Option("--rows", help="This row; give it again for more. None: all.")
    ] = None,
    scans: Annotated[int, typer.Option(min=1, max=200, help="Scans of the agreement with OctoMap.")] = 200,
    rounds: Annotated[int, typer.Option(min=1, max=100, help="Rounds of each, smallest times count.")] = 5,
    data: Annotated[Path, typer.Option(help="Folder with the real scans lidar_*.")] = Path("data"),
    prototype: Annotated[
        Path | None,
        typer.Option(help="Python file with another map, class VoxMap, that takes its turn at insertion."),
    ] = None,
    out: Annotated[Path | None, typer.Option(help="Write the rows there, too, one JSON object per line.")] = None,
    as_json: Json = False,
) -> None:
    r"""Measure the map beside OctoMap, edt and scipy. Example: companion bench mapping --rows insert_os64_0.2

    Peers and own code take turns in this process; times are CPU times. All rows take about half an hour.
    The peers come with: pip install 'understory\[bench]'. JSON is also printed if standard output is no terminal.
    """
    console, done = Console(), list[MappingRow]()
    plain = as_json or not console.is_terminal
    check_out(out)
    measured = bench_mapping(rows or [], Options(scans=scans, rounds=rounds, data=data, prototype=prototype))
    for row in written(measured, out=out, plain=plain):
        done.append(row)
        if not plain:
            console.print(f"{row.name}: {row.skipped or 'done'}", highlight=False)
    if not plain:
        console.print(mapping_table(done))


def mapping_table(rows: list[MappingRow]) -> Table:
    """The rows as people read them."""
    table = Table(title="Voxel map and distance field beside their peers; smallest of the rounds of each")
    for name in _COLUMNS:
        table.add_column(name, justify="left" if name in ("row", "peer", "further figures") else "right")
    for row in rows:
        table.add_row(*cells(row))
    return table


def cells(row: MappingRow) -> list[str]:
    """One text per column."""
    if row.skipped:
        return [row.name, row.peer, *[""] * 6, f"skipped: {row.skipped}"]
    of = "" if row.gauge == "ratio" else f" ({row.gauge})"
    goals = [
        "" if goal is None else f"{goal:g}{of} {'met' if met else 'not met'}"
        for goal, met in ((row.target, row.met), (row.aim, row.aim_met))
    ]
    numbers = [
        "" if x is None else f"{x:.3g}" if x < 1000 else f"{x:.0f}" for x in (row.ours_ms, row.peer_ms, row.ratio)
    ]
    more = ", ".join(f"{name} {value:.7g}" for name, value in row.figures.items())
    return [row.name, row.peer, *numbers, f"{row.rounds or ''}", *goals, more]
