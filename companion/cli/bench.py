"""`companion bench`: measure this machine."""

from __future__ import annotations

from typing import Annotated

import msgspec
import typer
from rich.console import Console
from rich.table import Table

from companion.cli.bus_options import Json, say
from companion.runtime.bench.bus import BusRow, bench_bus

COLUMNS = (
    "way", "CPU send %", "CPU hear %", "p50 ms", "p99 ms", "max ms", "gap p99 ms", "msg/s", "MB/s", "setpoints lost",
    "others lost",
)  # fmt: skip


def bus(
    for_s: Annotated[float, typer.Option("--for-s", min=1, max=3600, help="Seconds for each row.")] = 20.0,
    as_json: Json = False,
) -> None:
    """Measure the bus at the full load of a flight, between two processes. Example: companion bench bus

    Rows: the bus as it flies; the same messages with one class for all and the queues that Zenoh has by default;
    raw bytes of the same sizes, the floor.
    JSON is also printed if standard output is no terminal.
    """
    console, rows = Console(), []
    plain = as_json or not console.is_terminal
    for row in bench_bus(for_s=for_s):
        rows.append(row)
        if plain:
            say(msgspec.json.encode(row).decode())
        else:
            console.print(f"{row.way}: done, machine load {row.machine_load} on {row.cores} cores", highlight=False)
    if not plain:
        console.print(_table(rows))


def _table(rows: list[BusRow]) -> Table:
    how = "" if rows[0].ran_first else "; not allowed to run before other processes, so late by those, too"
    table = Table(title=f"Bus at full load, {rows[0].for_s:g} s each; setpoints end to end{how}")
    for name in COLUMNS:
        table.add_column(name, justify="left" if name == "way" else "right")
    for r in rows:
        others = ", ".join(f"{t} {n} of {r.sent[t]}" for t, n in r.lost.items() if n and t != "tracking/setpoint")
        figures = (
            r.cpu_send_percent, r.cpu_hear_percent, r.latency_p50_ms, r.latency_p99_ms, r.latency_max_ms, r.gap_p99_ms,
            r.messages_per_s, r.mb_per_s,
        )  # fmt: skip
        setpoints = f"{r.lost['tracking/setpoint']} of {r.sent['tracking/setpoint']}"
        table.add_row(r.way, *(f"{f:g}" for f in figures), setpoints, others or "none")
    return table
