"""`companion bench estimation`: accuracy, honesty and cost of the estimators, on recorded flights."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.console import Console
from rich.table import Table

from companion.cli.bench_rows import check_out, written
from companion.cli.bench_tracking import GUSTS, course_mission, one_of, speed_limits
from companion.cli.bus_options import Json
from companion.cli.flight_input import stack_config
from companion.cli.simulation import open_simulator
from companion.config import Config
from companion.core.errors import InputError
from companion.runtime.bench.estimation import EstimationRow, bench_flight
from companion.runtime.bench.estimation_courses import ring, tour
from companion.runtime.bench.estimation_faults import fault
from companion.runtime.bench.estimation_peers import missing
from companion.runtime.bench.estimation_recording import LOG, record_course
from companion.runtime.bench.estimation_starts import StartRow, wrong_starts

WORLDS = {
    "forest": "poisson,size_m=150,stems_per_ha=300,branches=4,roughness_m=0.15,margin_m=30",
    "clearing": "poisson,size_m=150,stems_per_ha=300,branches=4,roughness_m=0.05,clearing_m=45,start_m=75/75,"
    "margin_m=30",
    "poles": "poisson,size_m=150,stems_per_ha=300,min_spacing_m=2.5,dbh_mean_m=0.05,dbh_sd_m=0.01,crown=false,"
    "branches=0,roughness_m=0.15,margin_m=30",
}
COLUMNS = (
    "flight", "fault", "estimator", "ATE m", "drift %", "1 s m", "front ms", "all ms", "tilt", "yaw", "v", "bg", "ba",
    "p", "in 3 sigma", "rank", "gap m",
)  # fmt: skip


def estimation(
    courses: Annotated[str, typer.Option(help="Of forest, clearing, poles; with commas.")] = "forest,clearing",
    speeds: Annotated[str, typer.Option(help="Speed limits, m/s; always 4 in the clearing.")] = "4,8",
    seeds: Annotated[str, typer.Option(help="Seeds of world, gusts and sensors.")] = "1",
    faults: Annotated[
        list[str] | None, typer.Option("--fault", help="none, range_12,no_camera, lidar_gap_3@40, ...; repeatable.")
    ] = None,
    recordings: Annotated[Path | None, typer.Option(help="Where flights are kept and found again.")] = None,
    flight: Annotated[Path | None, typer.Option(help="A flight flown with --record instead.")] = None,
    with_peers: Annotated[bool, typer.Option("--peers/--no-peers", help="KISS-ICP and small_gicp, too.")] = True,
    peers_until_s: Annotated[
        float, typer.Option(min=1, help="Flown seconds that peers get: KISS-ICP may take a second for a sweep.")
    ] = 40.0,
    joint_window: Annotated[
        bool, typer.Option("--joint-window", help="Rows of the graph and of a joint window beside the filter, too.")
    ] = False,
    wrong_start: Annotated[
        str, typer.Option(help="Instead: who finds back from starts so far off, m/degrees; with commas: 0.3/3,0.6/6.")
    ] = "",
    set_: Annotated[
        list[str] | None, typer.Option("--set", help="Override, sim.* of what is recorded, too; repeatable.")
    ] = None,
    out: Annotated[Path | None, typer.Option(help="Write the rows there, too, one JSON object per line.")] = None,
    as_json: Json = False,
) -> None:
    """Measure the estimators against the truth. Example: companion bench estimation --courses forest --speeds 4

    Each flight is flown by the truth and recorded once, then replayed into the estimators. NEES is per degree of
    freedom: 1 is honest. CPU times are those of this thread. JSON is also printed if standard output is no terminal.
    """
    check_out(out)
    offsets = _offsets(wrong_start)
    asked = faults or ["none"]
    for text in asked:
        fault(text)
    if with_peers and missing():
        Console(stderr=True).print(f"no {', '.join(missing())}: pip install 'understory\\[bench]'", style="dim")
    config, console = stack_config(None, tuple(set_ or ())), Console()
    own = [o for o in set_ or () if o.startswith("sim.")]
    plain, peers_s = as_json or not console.is_terminal, peers_until_s if with_peers else 0.0
    with tempfile.TemporaryDirectory() as scratch:
        folders = (
            [(flight, flight.name)] if flight else _folders(courses, speeds, seeds, recordings or Path(scratch), own)
        )
        if offsets:
            _from_wrong_starts(folders, asked, config, offsets, (out, plain, console))
            return
        done = list(written(_rows(folders, asked, config, peers_s, joint_window), out=out, plain=plain))
    if not plain:
        console.print(estimation_table(done))


def _rows(
    folders: Sequence[tuple[Path, str]] | Iterator[tuple[Path, str]],
    faults: list[str],
    config: Config,
    peers_s: float,
    joint: bool,
) -> Iterator[EstimationRow]:
    for folder, name in folders:
        yield from bench_flight(folder, name, faults, config, peers_until_s=peers_s, joint=joint)


def _from_wrong_starts(
    folders: Sequence[tuple[Path, str]] | Iterator[tuple[Path, str]],
    faults: list[str],
    config: Config,
    offsets: list[tuple[float, float]],
    where: tuple[Path | None, bool, Console],
) -> None:
    out, plain, console = where
    rows = (
        row
        for folder, name in folders
        for text in faults
        for offset in offsets
        for row in wrong_starts(folder, name, text, config, offset)
    )
    done = list(written(rows, out=out, plain=plain))
    if not plain:
        console.print(_starts_table(done))


def _starts_table(rows: list[StartRow]) -> Table:
    table = Table(title="From wrong starts: found back within 5 cm and 0.5 degrees after 3 s of sweeps")
    for name in ("flight", "fault", "estimator", "off m", "off deg", "found back", "first m", "last m", "worst m"):
        table.add_column(name)
    for r in rows:
        figures = (f"{x:.3f}" for x in (r.first_m, r.last_m, r.worst_m))
        found = f"{r.recovered} of {r.starts}"
        table.add_row(r.flight, r.fault, r.estimator, f"{r.offset_m:g}", f"{r.offset_deg:g}", found, *figures)
    return table


def _folders(courses: str, speeds: str, seeds: str, parent: Path, own: list[str]) -> Iterator[tuple[Path, str]]:
    """Folder and name of each flight; one that is not there is recorded now."""
    for course in courses.split(","):
        kind = one_of(course, tuple(WORLDS), "--courses")
        for speed in [4.0] if kind == "clearing" else speed_limits(speeds):
            for seed in _seeds(seeds):
                folder = parent / f"{kind}_{speed:g}_{seed}"
                if not (folder / LOG).is_file():
                    _record(kind, speed, seed, folder, own)
                yield folder, folder.name


def _record(kind: str, speed: float, seed: int, folder: Path, own: list[str]) -> None:
    console = Console(stderr=True)
    console.print(f"recording {folder.name}", style="dim", highlight=False)
    with open_simulator(WORLDS[kind], seed, [*GUSTS, *own], 0, console) as sim:
        course = ring(top_m_s=speed) if kind == "clearing" else tour(sim.world.cones, top_m_s=speed, seed=seed)
        record_course(course, folder, stack_config(None, ()), sim=sim.new_node(), mission=course_mission())


def _offsets(text: str) -> list[tuple[float, float]]:
    """Pairs of metres and degrees."""
    try:
        pairs = [part.split("/") for part in text.split(",") if part]
        return [(float(m), float(deg)) for m, deg in pairs]
    except ValueError:
        raise InputError(f"{text!r}", field="--wrong-start", valid="metres/degrees, with commas: 0.3/3,0.6/6") from None


def _seeds(text: str) -> list[int]:
    try:
        return [int(part) for part in text.split(",")]
    except ValueError:
        raise InputError(f"{text!r}", field="--seeds", valid="whole numbers, with commas") from None


def estimation_table(rows: list[EstimationRow]) -> Table:
    """The rows as people read them."""
    table = Table(title="Estimators against the truth; NEES per degree of freedom")
    for name in COLUMNS:
        table.add_column(name, justify="left" if name in COLUMNS[:3] else "right")
    for row in rows:
        table.add_row(*cells(row))
    return table


def cells(row: EstimationRow) -> list[str]:
    """One text per column."""
    n = row.nees
    parts = (n.tilt, n.yaw, n.velocity, n.gyro_bias, n.accel_bias, n.position) if n else (None,) * 6
    return [
        row.flight, row.fault, row.estimator, f"{row.ate_m:.3f}", f"{row.drift_percent:.3f}",
        "" if row.relative_m is None else f"{row.relative_m:.3f}", f"{row.front_ms:.1f}",
        f"{row.all_ms:.1f}", *("" if x is None else f"{x:.2f}" for x in (*parts, row.covered, row.quality_rank)),
        f"{np.median([g.error_m for g in row.gaps]):.3f}" if row.gaps else "",
    ]  # fmt: skip
