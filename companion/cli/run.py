"""`companion run`: fly a mission with a vehicle that is reached by MAVLink, in real time."""

from __future__ import annotations

import time
from contextlib import ExitStack
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.markup import escape
from rich.status import Status

from companion.cli.children import recorder
from companion.cli.flight_input import read_text, stack_config
from companion.cli.ground_options import Allowed, Certificates, Rates, ground_settings
from companion.cli.live_outcome import print_live, write_live
from companion.cli.signals import on_interrupt
from companion.config import Config, dump_config
from companion.core import topics
from companion.core.errors import LinkError
from companion.mission.model import Mission, parse_mission
from companion.report.live_summary import LiveSummary
from companion.report.tracks import Tracks
from companion.runtime.bus.attach import BusOutlet, Hearing
from companion.runtime.bus.directory import Directory
from companion.runtime.bus.graph import Graph
from companion.runtime.bus.ground import GroundSettings, open_ground
from companion.runtime.bus.reports import Reports
from companion.runtime.bus.session import ENDPOINT, open_session
from companion.runtime.bus.simulated_clock import join_clock
from companion.runtime.clock import Clock
from companion.runtime.monitor import WATCHED, Monitor
from companion.runtime.pipes import Assignment
from companion.runtime.ports.endpoint import parse_endpoint
from companion.runtime.ports.key_file import load_key
from companion.runtime.supervisor import Supervisor
from companion.stack import GROUPS

LOOK_S = 0.02
JOINING_LOOKS, JOINING_PAUSE_S = 5, 0.1


@dataclass(frozen=True, slots=True, kw_only=True)
class RunRequest:
    """What is to be flown, by which vehicle."""

    mission: Mission
    mission_text: str
    config: Config
    link: str
    vehicle: str
    bus: str
    seed: int
    out: Path
    log: bool
    speed: float = 1.0
    record: bool = False
    key_file: str = ""
    ground: GroundSettings | None = None


def run(
    mission: Annotated[Path, typer.Argument(help="Mission YAML, such as missions/first_flight.yaml.")],
    vehicle: Annotated[str, typer.Option(help="MAVLink URL, such as udp://127.0.0.1:14540.")],
    config: Annotated[Path | None, typer.Option(help="Configuration YAML; holds only differences.")] = None,
    set_: Annotated[
        list[str] | None, typer.Option("--set", help="Override, such as tracking.lookahead_s=0.5; repeatable.")
    ] = None,
    out: Annotated[Path | None, typer.Option(help="Output folder [flights/<time>-<mission>].")] = None,
    name: Annotated[str, typer.Option(help="Name of the vehicle on the bus.")] = "drone1",
    bus: Annotated[str, typer.Option(help="Zenoh endpoint of the bus.")] = ENDPOINT,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the planner.")] = 0,
    speed: Annotated[float, typer.Option(min=0.05, max=20, help="That of `companion sim`, if not real time.")] = 1.0,
    key: Annotated[Path | None, typer.Option(help="Key file that signs MAVLink; see `companion keys`.")] = None,
    ground: Annotated[
        str, typer.Option(help="Telemetry for ground stations on tls/HOST:PORT, such as tls/0.0.0.0:7448.")
    ] = "",
    ground_certs: Certificates = None,
    ground_rate: Rates = None,
    ground_allow: Allowed = None,
    log: Annotated[bool, typer.Option(help="Write what `companion replay` needs.")] = True,
    record: Annotated[bool, typer.Option(help="Record the bus into flight.mcap, too.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print the summary as JSON.")] = False,
    quiet: Annotated[bool, typer.Option("--quiet", help="Print nothing but errors.")] = False,
) -> None:
    """Fly MISSION with a vehicle. Example: companion run missions/first_flight.yaml --vehicle udp://127.0.0.1:14540

    Ctrl-C lands; a second one ends at once and leaves the vehicle to its autopilot.
    Exit code 0: completed; 1: the flight failed; 2: wrong input; 3: no vehicle, no bus, or both taken.
    """
    text = read_text(mission)
    parsed = parse_mission(text, file=str(mission))
    request = RunRequest(
        mission=parsed,
        mission_text=text,
        config=stack_config(config, tuple(set_ or ())),
        link=str(parse_endpoint(vehicle, udp_means="in", field="--vehicle")),
        vehicle=name,
        bus=bus,
        seed=seed,
        out=out or Path("flights") / f"{datetime.now():%Y-%m-%d-%H%M%S}-{parsed.name}",
        speed=speed,
        log=log,
        record=record,
        key_file=str(key.resolve()) if key else "",
        ground=ground_settings(ground, ground_certs, ground_rate or (), ground_allow or (), bus=bus, vehicle=name),
    )
    if key:
        load_key(key)  # a bad one is told now, not by a child
    console = Console(quiet=quiet or as_json, stderr=as_json)
    summary, _ = fly_live(request, console)
    print_live(summary, request.out, console, as_json=as_json)
    if not summary.completed:
        raise typer.Exit(1)


def fly_live(request: RunRequest, console: Console) -> tuple[LiveSummary, Tracks]:
    """Fly it, write everything into `request.out`, return what came out and what was seen."""
    request.out.mkdir(parents=True, exist_ok=True)
    with ExitStack() as stack:
        session = stack.enter_context(open_session("first", endpoint=request.bus))
        graph = stack.enter_context(Graph(session))
        _refuse_a_second(Directory(graph), request)
        clock = join_clock(graph, Clock.of_host(), speed=request.speed)
        if request.ground:
            stack.enter_context(open_ground(request.ground, bus=request.bus, vehicle=request.vehicle))
        tracks = Tracks()
        monitor = Monitor([tracks])
        Hearing(graph, WATCHED, monitor, listener="monitor", vehicle=request.vehicle)
        bus = BusOutlet(graph, {"supervisor": [topics.HEALTH]}, vehicle=request.vehicle)
        supervisor = Supervisor(
            _assignments(request, clock),
            clock=clock,
            health=lambda m: bus.publish(topics.HEALTH, m, m.stamp_ns),
            airborne=lambda: monitor.airborne,
        )
        reports = Reports(graph, clock=clock, vehicle=request.vehicle)
        if request.record:
            stack.enter_context(recorder(request.out, request.bus))
        lost = _fly(supervisor, monitor, tracks, reports, console)
        return write_live(request, supervisor, monitor, tracks, lost), tracks


def _fly(supervisor: Supervisor, monitor: Monitor, tracks: Tracks, reports: Reports, console: Console) -> str:
    """Start, watch and end the groups; returns why the flight was lost, or ''."""
    lost, told, interrupts = "", 0, _Interrupts()
    with on_interrupt(interrupts.take), console.status("starting") as status:
        try:
            status.update("compiling kernels (first start: up to a minute of CPU; cached afterwards)")
            supervisor.start()
            tracks.zero_ns = reports.clock.now_ns()
            while not monitor.over and not lost and interrupts.count < 2:
                lost = supervisor.watch()
                monitor.look()
                reports.look(supervisor.reports())
                told = _tell(supervisor, told, reports, console)
                _show(status, monitor)
                if interrupts.count == 1 and not interrupts.answered:
                    interrupts.answered = True
                    console.print("Ctrl-C: landing; once more ends at once")
                    if not monitor.airborne:
                        break
                    supervisor.land()
                time.sleep(LOOK_S)
        finally:
            status.update("ending")
            killed = supervisor.stop()
            monitor.look()
            _tell(supervisor, told, reports, console)
    if killed:
        console.print(f"had to be killed: {', '.join(killed)}")
    return lost or ("stopped by Ctrl-C" if interrupts.count else "")


def _tell(supervisor: Supervisor, told: int, reports: Reports, console: Console) -> int:
    for event in supervisor.events[told:]:
        reports.event(event)
        console.print(event, highlight=False, markup=False)
    return len(supervisor.events)


def _show(status: Status, monitor: Monitor) -> None:
    vehicle, mission, safety = monitor.vehicle, monitor.mission, monitor.safety
    if mission is None or vehicle is None:
        status.update("waiting for the vehicle")
        return
    height, speed = vehicle.p_odom[2], float((vehicle.v_odom @ vehicle.v_odom) ** 0.5)
    guard = f"   {safety.action}: {safety.reason}" if safety is not None and safety.action != "ok" else ""
    what = mission.reason if mission.state == "waiting" else f"{mission.step_index + 1}/{mission.step_count}"
    line = f"{mission.step_id} {what}   {vehicle.mode}   {height:.1f} m up   {speed:.1f} m/s{guard}"
    status.update(escape(line))  # reasons hold the vehicle's own words


@dataclass(slots=True)
class _Interrupts:
    count: int = 0
    answered: bool = False

    def take(self) -> None:
        self.count += 1


def _refuse_a_second(directory: Directory, request: RunRequest) -> None:
    """Look for more than a moment: a session that has just joined does not know everybody yet."""
    for _ in range(JOINING_LOOKS):
        for node in directory.nodes():
            if node.namespace == f"/{request.vehicle}" and node.node == "AutopilotNode":
                raise LinkError(
                    f"another companion flies {request.vehicle} on the bus at {request.bus}: "
                    "end it first, or choose another --name and --vehicle"
                )
        time.sleep(JOINING_PAUSE_S)


def _assignments(request: RunRequest, clock: Clock) -> list[Assignment]:
    config = dump_config(request.config)
    return [
        Assignment(
            group=group,
            mission=request.mission_text,
            config=config,
            seed=request.seed,
            vehicle=request.vehicle,
            bus=request.bus,
            clock_offset_ns=clock.offset_ns,
            clock_speed=clock.speed,
            clock_since_ns=clock.since_ns,
            out=str(request.out),
            link=request.link if group == "control" else "",
            key_file=request.key_file if group == "control" else "",
            log=request.log,
        )
        for group in GROUPS
    ]
