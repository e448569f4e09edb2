"""What a live flight leaves in its folder and prints at the end."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING

import typer
from rich.console import Console
from rich.table import Table

from companion.config import dump_config
from companion.report.live_summary import LiveSummary, percentiles, to_json
from companion.report.summary import estimated_figures, trajectory_figures
from companion.report.tracks import Tracks
from companion.runtime.child import Child
from companion.runtime.monitor import Monitor
from companion.runtime.supervisor import Supervisor

if TYPE_CHECKING:
    from companion.cli.run import RunRequest


def write_live(request: RunRequest, supervisor: Supervisor, monitor: Monitor, tracks: Tracks, lost: str) -> LiveSummary:
    """Write summary, mission, configuration and why log; the groups have written their logs."""
    out = request.out
    summary = _summary(request, supervisor, monitor, tracks, lost)
    (out / "summary.json").write_bytes(to_json(summary))
    (out / "mission.yaml").write_text(request.mission_text, encoding="utf-8")
    (out / "config.yaml").write_text(dump_config(request.config), encoding="utf-8")
    lines = [
        f"{(w.stamp_ns - tracks.zero_ns) * 1e-9:9.3f} s  {w.node}: {w.what}, because {w.because}\n" for w in tracks.why
    ]
    (out / "why.log").write_text("".join(lines), encoding="utf-8")
    return summary


def _summary(request: RunRequest, supervisor: Supervisor, monitor: Monitor, tracks: Tracks, lost: str) -> LiveSummary:
    ending, children = monitor.ending(lost=lost), supervisor.children
    control = next((c.figures for c in children if c.name == "control"), {})
    span_s = max((c.running_s for c in children), default=0.0)
    nodes = [node for c in children if c.beat for node in c.beat.nodes]
    losses: dict[str, float] = {}
    for child in children:
        losses |= {k.removeprefix("lost "): v for k, v in child.figures.items() if k.startswith("lost ")}
    return LiveSummary(
        completed=ending.completed,
        contact=bool(ending.contact),
        touched=ending.contact,
        reason=ending.reason,
        mission=request.mission.name,
        vehicle=request.vehicle,
        link=request.link,
        duration_s=span_s,
        figures=trajectory_figures(tracks) if tracks.truth else estimated_figures(tracks),
        setpoint_gap_ms=percentiles(control, "setpoint_gap"),
        sweep_to_setpoint_ms=percentiles(control, "sweep_to_setpoint"),
        lost=losses,
        dropped={n.name: n.dropped for n in nodes if n.dropped},
        late_ticks={n.name: n.late_ticks for n in nodes if n.late_ticks},
        restarts={k: v for k, v in supervisor.restarts.items() if v},
        events=supervisor.events,
        cpu_percent={c.name: 100.0 * _cpu_s(c) / max(c.running_s, 1e-3) for c in children},
        memory_mb={c.name: c.beat.memory_mb for c in children if c.beat},
        link_figures={k: v for k, v in control.items() if k.startswith("link_")},
    )


def _cpu_s(child: Child) -> float:
    return child.beat.cpu_s - child.warm_cpu_s if child.beat else 0.0


def print_live(summary: LiveSummary, out: Path, console: Console, *, as_json: bool) -> None:
    """The table of at most twelve rows, or JSON on standard output."""
    if as_json:
        typer.echo(to_json(summary))
        return
    console.print(live_table(summary, out))


def live_table(summary: LiveSummary, out: Path) -> Table:
    """What a live flight came to, label and text."""
    f, gap, age = summary.figures, summary.setpoint_gap_ms, summary.sweep_to_setpoint_ms
    rows = {
        "completed": "[green]yes[/]" if summary.completed else f"[red]no[/]: {summary.reason}",
        "path": f"{f['path_length_m']:.1f} m in {summary.duration_s:.1f} s",
        **_against_truth(summary),
        "setpoint gaps": _percentiles(gap),
        "sweep to setpoint": _percentiles(age),
        "lost on the bus": ", ".join(f"{k} {v:.0f}" for k, v in summary.lost.items()) or "nothing",
        "restarts": ", ".join(f"{k} {v}" for k, v in summary.restarts.items()) or "none",
        "CPU": ", ".join(f"{k} {v:.0f} %" for k, v in summary.cpu_percent.items()),
        "folder": str(out),
    }
    table = Table(show_header=False, box=None, pad_edge=False)
    for label, text in rows.items():
        table.add_row(f"[bold]{label}[/]", text)
    return table


def _against_truth(summary: LiveSummary) -> dict[str, str]:
    """What only a simulator knows; nothing on a real vehicle."""
    f = summary.figures
    if math.isnan(f["min_clearance_m"]):
        return {}
    return {
        "contact": summary.touched or "none",
        "hull clearance": f"{f['min_clearance_m']:.2f} m at the nearest trunk or branch",
        "estimate's error": f"{f['position_rmse_m']:.3f} m rms, drift {f['drift_percent']:.3f} % of the path",
    }


def _percentiles(figures: dict[str, float]) -> str:
    if not figures:
        return "none"
    return f"p50 {figures['p50']:.1f} ms, p99 {figures['p99']:.1f} ms, of {figures['count']:.0f}"
