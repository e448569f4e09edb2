"""`companion fly --realtime`: the simulator and the stack as programs, as one would start them by hand."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from rich.console import Console

from companion.cli.children import beside
from companion.cli.run import RunRequest, fly_live
from companion.cli.simulation import scenery_of
from companion.core.errors import LinkError
from companion.report.flight_figure import draw_flight, headline
from companion.report.live_summary import LiveSummary
from companion.runtime.bus.session import ENDPOINT
from sim.world import load_world

if TYPE_CHECKING:
    from companion.cli.fly import Request

VEHICLE = "drone1"


def fly_realtime(request: Request, console: Console) -> LiveSummary:
    """Start `companion sim`, fly as `companion run` does, end both; the picture shows the true world."""
    request.out.mkdir(parents=True, exist_ok=True)
    port = _free_port()
    with _simulator(request, port):
        summary, tracks = fly_live(_run_request(request, port), console)
    title = headline(summary.mission, request.world, request.seed, summary.reason, summary.figures)
    draw_flight(request.out / "flight.png", tracks, scenery_of(load_world(request.world, seed=request.seed)), title)
    return summary


def _run_request(request: Request, port: int) -> RunRequest:
    return RunRequest(
        mission=request.mission,
        mission_text=request.mission_file.read_text(encoding="utf-8"),
        config=request.config,
        link=f"udpin://127.0.0.1:{port}",
        vehicle=VEHICLE,
        bus=ENDPOINT,
        seed=request.seed,
        out=request.out,
        log=True,
        record=request.record,
    )


@contextmanager
def _simulator(request: Request, port: int) -> Iterator[None]:
    """`companion sim` as a child; its summary goes to `simulator.json`, its words to `simulator.log`."""
    command = ["sim", "--world", request.world, "--seed", str(request.seed), "--name", VEHICLE, "--json"]
    command += ["--mavlink", f"udp://127.0.0.1:{port}"]
    for override in request.overrides:
        if override.startswith("sim."):
            command += ["--set", override]
    words = request.out / "simulator.log"
    with beside(command, out=request.out / "simulator.json", words=words) as sim:
        yield
        early = sim.poll()
    if early:
        text = words.read_text(errors="replace").strip()
        raise LinkError(f"the simulator ended with code {early}: {text.splitlines()[-1] if text else 'no word'}")


def _free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port
