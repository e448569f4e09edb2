"""What `companion fly` writes into its folder and prints at the end."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec
import typer
from rich.console import Console
from rich.table import Table

from companion.cli.simulation import Simulator, scenery_of
from companion.config import dump_config
from companion.core.node import Node
from companion.report.flight_figure import draw_flight, headline
from companion.report.summary import Summary, to_json, trajectory_figures
from companion.report.tracks import Tracks
from companion.runtime.flight import Flight
from companion.runtime.flight_log import FlightLog
from companion.runtime.map_file import MAP_FILE, save_map

if TYPE_CHECKING:
    from companion.cli.fly import Request


@dataclass(frozen=True, slots=True)
class Outcome:
    """A flown request."""

    summary: Summary
    out: Path
    picture: Path
    tracks: Tracks


def write_outcome(
    request: Request,
    flight: Flight,
    tracks: Tracks,
    log: FlightLog,
    sim: Simulator,
    stack: Sequence[Node],
    wall_s: float,
) -> Outcome:
    """Write summary, mission, configuration, map, why log and picture; `flight.log` is there already."""
    out = request.out
    summary = _summary(request, flight, tracks, log, sim, wall_s)
    (out / "summary.json").write_bytes(to_json(summary))
    shutil.copyfile(request.mission_file, out / "mission.yaml")
    (out / "config.yaml").write_text(dump_config(request.config), encoding="utf-8")
    (out / "simulator.yaml").write_text(sim.describe(), encoding="utf-8")
    _write_why(out / "why.log", tracks)
    save_map(out / MAP_FILE, stack)
    picture = out / "flight.png"
    title = headline(summary.mission, summary.world, summary.seed, summary.reason, msgspec.structs.asdict(summary))
    draw_flight(picture, tracks, scenery_of(sim.world), title)
    return Outcome(summary, out, picture, tracks)


def _summary(
    request: Request, flight: Flight, tracks: Tracks, log: FlightLog, sim: Simulator, wall_s: float
) -> Summary:
    ending = flight.ending(limit_s=request.limit_s)
    figures = trajectory_figures(tracks)
    cpu_s = flight.lockstep.cpu_s
    cpu_s |= sim.cpu_s(cpu_s.pop("SimNode"))
    return Summary(
        completed=ending.completed,
        contact=ending.contact,
        reason=ending.reason,
        seed=request.seed,
        world=request.world,
        mission=request.mission.name,
        **figures,
        wall_s=wall_s,
        real_time_factor=figures["duration_s"] / max(wall_s, 1e-9),
        cpu_s=cpu_s,
        compute_p95_ms=flight.lockstep.compute_ms(95),
        dropped={k: v for k, v in flight.lockstep.dropped.items() if v},
        messages=sum(log.counts.values()),
        flight_hash=log.flight_hash,
    )


def _write_why(path: Path, tracks: Tracks) -> None:
    lines = [f"{w.stamp_ns * 1e-9:9.3f} s  {w.node}: {w.what}, because {w.because}\n" for w in tracks.why]
    path.write_text("".join(lines), encoding="utf-8")


def print_outcome(outcome: Outcome, console: Console, *, as_json: bool) -> None:
    """The table of at most twelve rows, or JSON on standard output."""
    if as_json:
        typer.echo(to_json(outcome.summary))
        return
    console.print(outcome_table(outcome.summary, outcome.picture))


def outcome_table(s: Summary, picture: Path) -> Table:
    """What a flight came to, label and text."""
    table = Table(show_header=False, box=None, pad_edge=False)
    rows = {
        "completed": "[green]yes[/]" if s.completed else f"[red]no[/]: {s.reason}",
        "contact": s.contact or "none",
        "path": f"{s.path_length_m:.1f} m in {s.duration_s:.1f} s, {s.mean_speed_m_s:.2f} m/s while moving",
        "hull clearance": f"{s.min_clearance_m:.2f} m at the nearest trunk or branch",
        "estimate's error": f"{s.position_rmse_m:.3f} m rms, {s.end_error_m:.3f} m at the end",
        "drift": f"{s.drift_percent:.3f} % of the path",
        "speed of simulation": f"{s.real_time_factor:.2f} x real time, {s.wall_s:.1f} s",
        "CPU per simulated s": _largest(s),
        "flight hash": s.flight_hash[:16],
        "picture": str(picture),
    }
    for label, text in rows.items():
        table.add_row(f"[bold]{label}[/]", text)
    return table


def _largest(summary: Summary) -> str:
    per_s = {k: 1e3 * v / max(summary.duration_s, 1e-9) for k, v in summary.cpu_s.items()}
    top = sorted(per_s.items(), key=lambda item: -item[1])[:4]
    return ", ".join(f"{name} {ms:.0f} ms" for name, ms in top)
