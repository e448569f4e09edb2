"""`companion fly`: one command flies a mission in the simulator, in lockstep."""

from __future__ import annotations

import time
from contextlib import closing
from dataclasses import dataclass
from datetime import date
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn

from companion.cli import simulation
from companion.cli.flight_input import read_text, stack_config
from companion.cli.live_outcome import print_live
from companion.cli.outcome import Outcome, print_outcome, write_outcome
from companion.cli.realtime import fly_realtime
from companion.config import Config, dump_config
from companion.core.node import Node
from companion.mission.model import Mission, parse_mission
from companion.report.tracks import Tracks
from companion.runtime.file_shelf import FileShelf
from companion.runtime.flight import Flight
from companion.runtime.flight import Progress as Where
from companion.runtime.flight_log import FlightLog
from companion.runtime.lockstep import name
from companion.runtime.log_file import Header
from companion.stack import build, warm
from sim.rehearsal import rehearse

REHEARSAL_S = 3.0  # rest, first scans and images, arming, the beginning of the climb


@dataclass(frozen=True, slots=True, kw_only=True)
class Request:
    """What is to be flown."""

    mission_file: Path
    mission: Mission
    config: Config
    overrides: tuple[str, ...]
    world: str
    seed: int
    out: Path
    workers: int
    limit_s: float
    log_all: bool
    record: bool = False


def fly(
    mission: Annotated[Path, typer.Argument(help="Mission YAML, such as missions/first_flight.yaml.")],
    world: Annotated[str, typer.Option(help="World name, YAML file, or stems:FILE.csv.")] = "demo",
    seed: Annotated[int, typer.Option(min=0, help="Same seed, same bytes.")] = 0,
    set_: Annotated[
        list[str] | None,
        typer.Option("--set", help="Override, such as tracking.lookahead_s=0.5; repeatable."),
    ] = None,
    config: Annotated[Path | None, typer.Option(help="Configuration YAML; holds only differences.")] = None,
    out: Annotated[Path | None, typer.Option(help="Output folder [flights/<date>-<mission>].")] = None,
    cores: Annotated[int, typer.Option(min=1, max=2, help="2 casts rays in a second process.")] = 2,
    limit_s: Annotated[float, typer.Option(min=1, help="Simulated seconds after which to give up.")] = 900.0,
    log_all: Annotated[bool, typer.Option(help="Store raw scans, images and maps in the log, too.")] = False,
    record: Annotated[
        bool, typer.Option(help="Store raw scans and images for `companion replay`: 3 MB per flown second.")
    ] = False,
    realtime: Annotated[bool, typer.Option(help="In real time, as processes on the bus, instead of lockstep.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print the summary as JSON.")] = False,
    quiet: Annotated[bool, typer.Option("--quiet", help="Print nothing but errors.")] = False,
) -> None:
    """Fly MISSION in the simulator. Example: companion fly missions/first_flight.yaml --world poisson --seed 3

    Exit code 0: completed without contact; 1: the flight failed; 2: wrong input.
    """
    overrides = tuple(set_ or ())
    parsed = parse_mission(read_text(mission), file=str(mission))
    request = Request(
        mission_file=mission,
        mission=parsed,
        config=stack_config(config, overrides),
        overrides=overrides,
        world=world,
        seed=seed,
        out=out or Path("flights") / f"{date.today().isoformat()}-{parsed.name}",
        workers=cores - 1,
        limit_s=limit_s,
        log_all=log_all,
        record=record,
    )
    console = Console(quiet=quiet or as_json, stderr=as_json)
    if realtime:
        summary = fly_realtime(request, console)
        print_live(summary, request.out, console, as_json=as_json)
        if not summary.completed:
            raise typer.Exit(1)
        return
    outcome = fly_request(request, console)
    print_outcome(outcome, console, as_json=as_json)
    if not outcome.summary.completed:
        raise typer.Exit(1)


def fly_request(request: Request, console: Console) -> Outcome:
    """Fly it, write everything into `request.out`, return what came out."""
    request.out.mkdir(parents=True, exist_ok=True)
    started = time.perf_counter()
    with simulation.open_simulator(request.world, request.seed, request.overrides, request.workers, console) as sim:
        with console.status("compiling kernels (first start: up to a minute of CPU; cached afterwards)"):
            _rehearse(sim, request)
        console.print(f"world and kernels ready in {time.perf_counter() - started:.1f} s")
        log_file = request.out / "flight.log"
        with closing(FlightLog(log_file, store_all=request.log_all, record=request.record)) as log:
            tracks = Tracks()
            flight, stack = _prepare(sim, request, log, [tracks])
            log.begin(_header(request, stack))
            started = time.perf_counter()
            _run(flight, request, tracks, console)
            wall_s = time.perf_counter() - started
        return write_outcome(request, flight, tracks, log, sim, stack, wall_s)


def _prepare(
    sim: simulation.Simulator, request: Request, log: FlightLog, listeners: list[Tracks]
) -> tuple[Flight, list[Node]]:
    """A flight at its start, and the nodes of the stack in it."""
    stack = build(request.config, request.mission, seed=request.seed, shelf=FileShelf())
    return Flight([sim.new_node(), *stack], request.config.lockstep, log=log, listeners=listeners), stack


def _header(request: Request, stack: list[Node]) -> Header:
    """What a replay rebuilds the stack from."""
    return Header(
        group="lockstep",
        nodes=tuple(name(node) for node in stack),
        seed=request.seed,
        mission=read_text(request.mission_file),
        config=dump_config(request.config),
    )


def _rehearse(sim: simulation.Simulator, request: Request) -> None:
    """Fly up to the climb with nodes that are thrown away, so that kernels are compiled before the flight."""
    rehearse(sim.config, sim.world)
    flight, stack = _prepare(sim, request, FlightLog(None), [])
    warm(request.config, stack)
    for _ in flight.run(limit_s=REHEARSAL_S):
        pass
    sim.renderer.cpu_s.update(dict.fromkeys(sim.renderer.cpu_s, 0.0))


def _run(flight: Flight, request: Request, tracks: Tracks, console: Console) -> None:
    columns = (
        SpinnerColumn(),
        TextColumn("{task.description}"),
        BarColumn(bar_width=20),
        TextColumn("{task.fields[info]}"),
    )
    with Progress(*columns, console=console, transient=True) as bar:
        task = bar.add_task("flying", total=None, info="")
        try:
            for where in flight.run(limit_s=request.limit_s):
                _show(bar, task, where, tracks)
        except KeyboardInterrupt:
            console.print("stopped by Ctrl-C: writing what was flown so far")


def _show(bar: Progress, task: object, where: Where, tracks: Tracks) -> None:
    if where.truth is None:
        return
    speed = float((where.truth.v_world @ where.truth.v_world) ** 0.5)
    step, total, count = "starting", 1, 0
    if where.mission is not None:
        step, total, count = where.mission.step_id, where.mission.step_count, where.mission.step_index
    near = min((m.clearance_m for m in tracks.truth[-50:]), default=float("nan"))
    info = f"{where.time_s:6.1f} s simulated   {speed:4.1f} m/s   nearest branch {near:4.1f} m"
    bar.update(task, description=step, total=max(total, 1), completed=count, info=info)  # type: ignore[arg-type]
