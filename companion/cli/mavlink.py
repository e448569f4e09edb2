"""`companion mavlink inspect`: what a recorded MAVLink log holds."""

from __future__ import annotations

import gzip
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated

import msgspec
import typer
from rich.console import Console
from rich.table import Table

from companion.autopilot.inspect import LogReport, inspect_tlog
from companion.core.errors import InputError


def inspect(
    file: Annotated[Path, typer.Argument(help="A .tlog file, also gzipped (.tlog.gz).")],
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
) -> None:
    """Count messages, rates, senders and damage of a log. Example: companion mavlink inspect flight.tlog"""
    report = inspect_tlog(_read(file))
    if report.messages == 0:
        raise InputError("holds no intact MAVLink message", file=str(file), valid="a .tlog recording")
    if as_json:
        typer.echo(_json(report))
    else:
        _print(report, file)


def _read(file: Path) -> bytes:
    try:
        data = file.read_bytes()
        return gzip.decompress(data) if data[:2] == b"\x1f\x8b" else data
    except (OSError, EOFError) as error:
        raise InputError(f"cannot be read: {error}", file=str(file)) from error


def _json(report: LogReport) -> str:
    fields = msgspec.to_builtins(report)
    fields["duration_s"] = report.duration_s
    for row, traffic in zip(fields["traffic"], report.traffic, strict=True):
        row["rate_hz"] = round(traffic.rate_hz, 3)
    return msgspec.json.encode(fields).decode()


def _print(report: LogReport, file: Path) -> None:
    console = Console()
    table = Table("sender", "message", "count", "Hz", box=None, pad_edge=False)
    for column in table.columns[2:]:
        column.justify = "right"
    for t in report.traffic:
        table.add_row(f"{t.system}/{t.component}", t.name, f"{t.count:,}", f"{t.rate_hz:.1f}")
    console.print(table)
    start = datetime.fromtimestamp(report.first_us / 1e6, UTC)
    console.print(
        f"\n{file.name}: {report.messages:,} messages in {report.duration_s:.1f} s from {start:%Y-%m-%d %H:%M:%S} UTC",
        highlight=False,
    )
    console.print(
        f"{report.missing:,} lost or damaged by sequence numbers, {report.signed:,} signed, "
        f"{report.unknown:,} without definition",
        highlight=False,
    )
    _print_damage(report, console)


def _print_damage(report: LogReport, console: Console) -> None:
    console.print(f"{report.corrupt_pieces:,} corrupt pieces skipped ({report.corrupt_bytes:,} bytes)", highlight=False)
    if report.cut_off_bytes:
        console.print(f"the last record is cut off ({report.cut_off_bytes} bytes)", highlight=False)
    for what, count in report.foreign.items():
        console.print(f"of these {count:,} are whole frames of another definition: {what}", highlight=False)
