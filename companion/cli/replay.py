"""`companion replay`: feed the nodes of a recorded flight again and compare their outputs byte for byte."""

from __future__ import annotations

import json
import math
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.progress import Progress, SpinnerColumn, TextColumn
from rich.table import Table

import companion
from companion.core.errors import InputError
from companion.runtime.flight_folder import logs_of, read_header, rebuild
from companion.runtime.log_file import Header
from companion.runtime.message_diff import TopicDifferences
from companion.runtime.ports.key_file import load_key
from companion.runtime.replay import RECORD_HINT, Replay
from companion.runtime.replay_report import Difference, NodeReport


@dataclass(frozen=True, slots=True, kw_only=True)
class _How:
    """What was asked for."""

    node: str
    overrides: tuple[str, ...]
    chain: bool
    key: bytes | None


@dataclass(frozen=True, slots=True)
class _Done:
    """A replayed log."""

    replay: Replay
    header: Header
    duration_s: float
    wall_s: float


def replay(
    flight: Annotated[Path, typer.Argument(help="Folder of a flight, such as flights/demo, or one of its logs.")],
    node: Annotated[str, typer.Option(help="Replay this node alone, such as PlanningNode.")] = "",
    set_: Annotated[
        list[str] | None,
        typer.Option("--set", help="Replay with this changed, such as planning.spacing_m=0.2; repeatable."),
    ] = None,
    chain: Annotated[
        bool, typer.Option(help="With --set: nodes are fed what the changed nodes before them say.")
    ] = False,
    key: Annotated[Path | None, typer.Option(help="Key file with which the link was signed in flight.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the result as JSON.")] = False,
) -> None:
    """Replay FLIGHT. Example: companion replay flights/demo --node MappingNode

    Without --set every output must be the logged one to the byte. With --set each node gets the
    same inputs, and what it makes of them otherwise is shown per topic and field.
    Exit code 0: identical; 1: not, or the log is damaged; 2: wrong input.
    """
    overrides = tuple(set_ or ())
    if chain and not overrides:
        raise InputError("--chain is for changed parameters", field="--chain", valid="together with --set")
    console = Console(stderr=as_json, quiet=as_json)
    logs = [(log, read_header(log)) for log in logs_of(flight)]
    logs = [(log, header) for log, header in logs if not node or node in header.nodes]
    if not logs:
        raise InputError(f"{node!r} is no node of this flight", field="--node", valid=_nodes_of(flight))
    how = _How(node=node, overrides=overrides, chain=chain, key=load_key(key) if key else None)
    results = [_replay(log, header, how, console) for log, header in logs]
    if as_json:
        typer.echo(json.dumps(_to_json(results, changed=bool(overrides)), indent=2))
    for done in results:
        _print(done, console, changed=bool(overrides))
    if not all(done.replay.identical for done in results):
        raise typer.Exit(1)


def _nodes_of(flight: Path) -> str:
    return ", ".join(n for log in logs_of(flight) for n in read_header(log).nodes)


def _replay(log: Path, header: Header, how: _How, console: Console) -> _Done:
    columns = SpinnerColumn(), TextColumn("{task.description}")
    with Progress(*columns, console=console, transient=True) as bar:
        task = bar.add_task(f"{log.name}: building nodes")
        changed = rebuild(header, how.overrides, signing_key=how.key) if how.overrides else ()
        nodes = rebuild(header, signing_key=how.key)
        run = Replay(log, nodes, changed=changed, only=how.node, chain=how.chain)
        started, first_ns, shown_ns = time.perf_counter(), -1, 0
        for now_ns in run.run():
            first_ns = now_ns if first_ns < 0 else first_ns
            if now_ns - shown_ns > 100_000_000:
                shown_ns = now_ns
                bar.update(task, description=f"{log.name}: {(now_ns - first_ns) * 1e-9:.1f} s")
        return _Done(run, header, (run.end_ns - first_ns) * 1e-9, time.perf_counter() - started)


def _print(done: _Done, console: Console, *, changed: bool) -> None:
    run, header = done.replay, done.header
    speed = done.duration_s / max(done.wall_s, 1e-9)
    console.print(f"[bold]{run.path.name}[/]: {done.duration_s:.1f} s in {done.wall_s:.1f} s, {speed:.1f} x real time")
    if header.package != companion.__version__:
        console.print(f"[yellow]written by version {header.package}, replayed by {companion.__version__}[/]")
    if run.end_reason is None:
        console.print("[yellow]the log has no end: its process was killed, or the file was cut[/]")
    elif run.end_reason:
        console.print(f"[yellow]the log stopped before its flight: {run.end_reason}[/]")
    console.print(_node_table(run))
    if run.blocked and not run.only:
        missing = ", ".join(f"{n} ({topic} of {source})" for n, (topic, source) in run.blocked.items())
        console.print(
            f"not replayed, since inputs are not stored: {missing}. That takes {RECORD_HINT}", highlight=False
        )
    if header.signed and "AutopilotNode" in header.nodes and "AutopilotNode" not in run.reports and not run.only:
        console.print("AutopilotNode is not replayed: a key signed its link, give it with --key")
    if run.first:
        _print_difference("[red]first difference[/]", run.first, console)
    if changed:
        _print_changed(run, console)


def _node_table(run: Replay) -> Table:
    table = Table("node", "deliveries", "outputs", "result", box=None, pad_edge=False)
    for name, report in run.reports.items():
        result = f"[red]{report.differing} differ[/]" if report.differing else "identical"
        table.add_row(name, str(report.deliveries), str(report.outputs), result)
    return table


def _print_changed(run: Replay, console: Console) -> None:
    found = [r.first_changed for r in run.reports.values() if r.first_changed]
    if not found:
        console.print("the change makes no difference to any output")
        return
    first = min(found, key=lambda d: d.time_ns)
    _print_difference("first output that is changed", first, console)
    table = Table("node", "topic", "compared", "differing", "missing", "new", "largest |difference|", box=None)
    for node, report in run.reports.items():
        for topic, t in report.changed.items():
            if t.differing or t.only_logged or t.only_replayed:
                counts = map(str, (t.compared, t.differing, t.only_logged, t.only_replayed))
                table.add_row(node, topic, *counts, _largest(t))
    console.print(table)


def _largest(t: TopicDifferences) -> str:
    numbers = [f"{k} {v:.3g}" for k, v in t.largest.items()]
    return ", ".join(numbers + [f"{k} otherwise in {v}" for k, v in t.other.items()])


def _to_json(results: list[_Done], *, changed: bool) -> dict[str, Any]:
    return {
        "identical": all(d.replay.identical for d in results),
        "logs": [
            {
                "file": str(d.replay.path),
                "group": d.header.group,
                "duration_s": d.duration_s,
                "wall_s": d.wall_s,
                "end": d.replay.end_reason,
                "not_replayed": {n: f"{t} of {s} is not stored" for n, (t, s) in d.replay.blocked.items()},
                "nodes": {n: _node_json(r, changed=changed) for n, r in d.replay.reports.items()},
            }
            for d in results
        ],
    }


def _node_json(report: NodeReport, *, changed: bool) -> dict[str, Any]:
    plain: dict[str, Any] = {
        "deliveries": report.deliveries,
        "outputs": report.outputs,
        "differing": report.differing,
        "first": str(report.first) if report.first else None,
    }
    if changed:
        plain["first_changed"] = str(report.first_changed) if report.first_changed else None
        plain["changed"] = {
            topic: {
                "compared": t.compared,
                "differing": t.differing,
                "only_logged": t.only_logged,
                "only_replayed": t.only_replayed,
                "largest": {k: v if math.isfinite(v) else None for k, v in t.largest.items()},
                "other": t.other,
            }
            for topic, t in report.changed.items()
        }
    return plain


def _print_difference(title: str, difference: Difference, console: Console) -> None:
    console.print(f"{title}: {difference.place}", highlight=False, soft_wrap=True)
    for line in difference.what:
        console.print("  " + line.replace("[", r"\["), highlight=False, soft_wrap=True)
