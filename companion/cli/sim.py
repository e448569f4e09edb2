"""`companion sim`: the simulated aircraft as a program, in real time, on real MAVLink."""

from __future__ import annotations

import gc
import math
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Annotated, Any

import msgspec
import typer
from rich.console import Console

from companion.cli import simulation
from companion.cli.signals import on_interrupt
from companion.core import topics
from companion.core.errors import CompanionError
from companion.core.messages import GroundTruth, MavlinkBytes
from companion.core.node import Topic
from companion.runtime.bus.attach import BusOutlet
from companion.runtime.bus.graph import Graph
from companion.runtime.bus.scene import ClockOutlet
from companion.runtime.bus.session import ENDPOINT, open_session
from companion.runtime.clock import Clock
from companion.runtime.live import Outlet
from companion.runtime.paced import Pace, Paced
from companion.runtime.ports.endpoint import Endpoint, parse_endpoint
from companion.runtime.ports.key_file import load_key
from companion.runtime.ports.mavlink_link import Link, open_link
from companion.runtime.priority import run_first
from sim.node import SimNode
from sim.rehearsal import rehearse
from sim.sensors.render import RenderError, WorkerRenderer

MOST_WAITING = 8  # requests to the render worker: 0.1 s of LiDAR and camera


class SimRequest(msgspec.Struct, frozen=True, kw_only=True):
    """What is to be simulated."""

    world: str
    seed: int
    speed: float
    links: tuple[Endpoint, ...]
    overrides: tuple[str, ...]
    name: str
    for_s: float
    key: bytes | None = None  # MAVLink signing
    bus: str = ""  # endpoint; '' for none


class SimSummary(msgspec.Struct, frozen=True, kw_only=True):
    """What came of it; times are simulated ones unless said."""

    name: str
    world: str
    seed: int
    speed: float
    simulated_s: float
    armed_s: float
    contact: str
    min_clearance_m: float | None  # None: nothing in reach
    slips: int
    slipped_s: float
    step_late_p99_ms: float
    step_late_max_ms: float
    late: dict[str, int]  # topic -> messages that came late, since the renderer was
    left_out: dict[str, int]  # sweeps and frames that were not rendered
    cpu_percent: float  # of one core, this process, per second of the wall clock
    render_cpu_percent: float  # the same of the render worker
    bytes_out: dict[str, int]  # per link
    bytes_in: dict[str, int]


def sim(
    world: Annotated[str, typer.Option(help="World name, YAML file, or stems:FILE.csv.")] = "demo",
    seed: Annotated[int, typer.Option(min=0, help="Seed of world and noise.")] = 0,
    speed: Annotated[float, typer.Option(min=0.05, max=20, help="Simulated seconds per second.")] = 1.0,
    mavlink: Annotated[
        str, typer.Option(help="Where the autopilot sends to; '' for nowhere.")
    ] = "udp://127.0.0.1:14540",
    gcs: Annotated[str, typer.Option(help="A second one, as for a ground station.")] = "udp://127.0.0.1:14550",
    set_: Annotated[list[str] | None, typer.Option("--set", help="Override, such as sim.wind.mean_m_s=3.")] = None,
    gps: Annotated[bool, typer.Option(help="Compass and GPS: it flies without a companion, too.")] = False,
    name: Annotated[str, typer.Option(help="Name of the vehicle on the bus.")] = "drone1",
    bus: Annotated[str, typer.Option(help="Zenoh endpoint of the bus; '' for none.")] = ENDPOINT,
    key: Annotated[Path | None, typer.Option(help="Key file of MAVLink signing, made by companion keys.")] = None,
    for_s: Annotated[float, typer.Option(min=0, help="End after so many simulated seconds [at Ctrl-C].")] = 0.0,
    as_json: Annotated[bool, typer.Option("--json", help="Print the summary as JSON.")] = False,
    quiet: Annotated[bool, typer.Option("--quiet", help="Print nothing but errors.")] = False,
) -> None:
    """Simulate an aircraft in real time; fly it by MAVLink. Example: companion sim --world poisson --gps

    Ctrl-C or SIGTERM ends it with a summary. Exit code 0: ended as asked; 2: wrong input; 3: address in use.
    """
    overrides = tuple(set_ or ())
    request = SimRequest(
        world=world,
        seed=seed,
        speed=speed,
        links=tuple(parse_endpoint(url, udp_means="out") for url in (mavlink, gcs) if url),
        overrides=("sim.open_sky=true", *overrides) if gps else overrides,
        name=name,
        for_s=for_s,
        bus=bus,
        key=load_key(key) if key else None,
    )
    console = Console(quiet=quiet, stderr=as_json, soft_wrap=True, highlight=False)
    stopped = Stopped()
    with on_interrupt(stopped.ask):
        try:
            summary = simulate(request, console, clock=Clock.of_host(), stopped=stopped)
        except KeyboardInterrupt:
            console.print("stopped before it was ready")
            return
    _show(summary, console, as_json=as_json)


@contextmanager
def on_bus(endpoint: str, vehicle: str) -> Iterator[list[Outlet]]:
    """The bus as an outlet of the simulated vehicle's sensors; none for ''."""
    if not endpoint:
        yield []
        return
    with open_session("first", endpoint=endpoint) as session, Graph(session) as graph:
        yield [BusOutlet(graph, {"SimNode": SimNode.publishes}, vehicle=vehicle), ClockOutlet(graph, vehicle=vehicle)]


class Stopped:
    """Whether somebody asked for the end; before `gently` was set, asking interrupts."""

    def __init__(self) -> None:
        self.asked = self.gently = False

    def ask(self) -> None:
        """Once for the end; a second time interrupts."""
        if self.asked or not self.gently:
            raise KeyboardInterrupt
        self.asked = True


def simulate(request: SimRequest, console: Console, *, clock: Clock, stopped: Stopped) -> SimSummary:
    """Run until somebody asked for the end."""
    opened = simulation.open_simulator(
        request.world, request.seed, request.overrides, 1, console, most_waiting=MOST_WAITING
    )
    with opened as simulator, ExitStack() as stack:
        with console.status("compiling kernels (first start: up to a minute of CPU; cached afterwards)"):
            _warm(simulator)
        run_first()  # as the hardware that this stands for; the render worker is there already and stays behind
        outlets = stack.enter_context(on_bus(request.bus, request.name))
        node, watch, wire = simulator.new_node(signing_key=request.key), Watch(), Wire()
        pace = Pace(clock.now_ns(), speed=request.speed)
        paced = Paced([node], pace=pace, outlets=[wire, watch, *outlets])
        for endpoint in request.links:
            link = open_link(endpoint, _poster(paced), clock=clock.now_ns, report=console.print)
            wire.links.append(stack.enter_context(link))
        _announce(request, console)
        usage = Usage(simulator)
        stopped.gently = True
        _fly(paced, clock, stopped, for_ns=round(request.for_s * 1e9), console=console)
        return _summary(request, paced, node, watch, wire, usage)


def _warm(simulator: simulation.Simulator) -> None:
    rehearse(simulator.config, simulator.world)
    if isinstance(simulator.renderer, WorkerRenderer):
        simulator.renderer.wait_ready()
    gc.collect()
    gc.freeze()  # what is there now stays: no pause for it in flight


def _fly(paced: Paced, clock: Clock, stopped: Stopped, *, for_ns: int, console: Console) -> None:
    warned = False
    try:
        while not stopped.asked and not 0 < for_ns <= paced.lockstep.now_ns:
            wait_ns = paced.step(clock.now_ns()) - clock.now_ns()
            if paced.pace.slips and not warned:
                warned = True
                console.print("this computer is too slow now: simulated time slips")
            if wait_ns > 0:
                time.sleep(wait_ns * 1e-9)
    except RenderError as error:
        raise CompanionError(f"LiDAR and camera cannot be rendered any more: {error}") from error


def _poster(paced: Paced) -> Any:
    return lambda data, stamp_ns: paced.post(topics.MAVLINK_TX(MavlinkBytes(stamp_ns=stamp_ns, data=data)))


class Wire:
    """Sends the autopilot's bytes to every link."""

    def __init__(self) -> None:
        self.links: list[Link] = []

    def publish(self, topic: Topic[Any], message: Any, now_ns: int) -> None:
        """Only what the autopilot says."""
        if topic is topics.MAVLINK_RX:
            for link in self.links:
                link.send(message.data)


class Watch:
    """Keeps of the truth what the summary tells."""

    def __init__(self) -> None:
        self.contact = ""
        self.min_clearance_m = math.inf
        self.armed_s = 0.0

    def publish(self, topic: Topic[Any], message: Any, now_ns: int) -> None:
        """Only the truth."""
        if topic is topics.TRUTH:
            truth: GroundTruth = message
            self.contact = self.contact or truth.contact
            self.min_clearance_m = min(self.min_clearance_m, truth.clearance_m)
            self.armed_s += 1.0 / topic.rate_hz if truth.armed else 0.0


class Usage:
    """CPU of this process and of the renderer since it was made."""

    def __init__(self, simulator: simulation.Simulator) -> None:
        self._cpu_s = simulator.renderer.cpu_s
        self._before = self._now()

    def _now(self) -> tuple[float, float, float]:
        return time.monotonic(), time.process_time(), sum(self._cpu_s.values())

    def percent(self) -> tuple[float, float]:
        """Of one core: this process, the renderer."""
        wall_s, own_s, render_s = (now - before for now, before in zip(self._now(), self._before, strict=True))
        return 100 * own_s / max(wall_s, 1e-3), 100 * render_s / max(wall_s, 1e-3)


def _announce(request: SimRequest, console: Console) -> None:
    console.print(f"{request.name} in world {request.world}, seed {request.seed}, {request.speed:g} x real time")
    for endpoint in request.links:
        console.print(f"  MAVLink to {endpoint}: listen there, as in {_example(endpoint)}")
    console.print("ready; Ctrl-C ends it")


def _example(endpoint: Endpoint) -> str:
    port = endpoint.port
    if port == 14550:
        return "QGroundControl, or mavproxy.py --master=udp:127.0.0.1:14550"
    return f"companion run MISSION --vehicle udp://127.0.0.1:{port}, or MAVSDK's udpin://127.0.0.1:{port}"


def _summary(request: SimRequest, paced: Paced, node: SimNode, watch: Watch, wire: Wire, usage: Usage) -> SimSummary:
    own, rendered = usage.percent()
    stats = {str(link.endpoint): link.stats for link in wire.links}
    return SimSummary(
        name=request.name,
        world=request.world,
        seed=request.seed,
        speed=request.speed,
        simulated_s=paced.lockstep.now_ns * 1e-9,
        armed_s=round(watch.armed_s, 2),
        contact=watch.contact,
        min_clearance_m=watch.min_clearance_m if math.isfinite(watch.min_clearance_m) else None,
        slips=paced.pace.slips,
        slipped_s=paced.pace.slipped_ns * 1e-9,
        step_late_p99_ms=round(paced.late_ms(99), 3),
        step_late_max_ms=round(paced.late_ms(100), 3),
        late=paced.lockstep.late,
        left_out=node.left_out,
        cpu_percent=round(own, 1),
        render_cpu_percent=round(rendered, 1),
        bytes_out={url: s.bytes_out for url, s in stats.items()},
        bytes_in={url: s.bytes_in for url, s in stats.items()},
    )


def _show(s: SimSummary, console: Console, *, as_json: bool) -> None:
    if as_json:
        typer.echo(msgspec.json.encode(s).decode())
        return
    near = "nothing in reach" if s.min_clearance_m is None else f"{s.min_clearance_m:.2f} m"
    console.print(f"simulated {s.simulated_s:.1f} s, motors on for {s.armed_s:.1f} s")
    console.print(f"contact {s.contact or 'none'}, least clearance {near}")
    console.print(f"slips {s.slips} ({s.slipped_s:.1f} s), step late p99 {s.step_late_p99_ms:.1f} ms")
    console.print(f"CPU {s.cpu_percent:.0f} % of a core, renderer {s.render_cpu_percent:.0f} %")
