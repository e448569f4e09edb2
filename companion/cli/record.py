"""`companion record`: what is said on the bus, into an MCAP file."""

from __future__ import annotations

import time
from datetime import datetime
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from companion.cli.bus_options import BUS, VEHICLE, Bus, Certs, ForS, Vehicle, stopping
from companion.core.errors import CompanionError
from companion.runtime.bus_recording import BusRecording
from companion.runtime.recorder import Recorder
from companion.runtime.tools.desk import Desk

LOOK_S = 1.0


def record(
    topics: Annotated[
        list[str] | None,
        typer.Argument(help="Topics, also with *: sensors/*; without any: all but hidden ones and whole local maps."),
    ] = None,
    out: Annotated[Path | None, typer.Option("--out", "-o", help="File to write [<time>.mcap].")] = None,
    split_mb: Annotated[int, typer.Option(min=0, help="Begin a new file beyond this size; 0: never.")] = 0,
    split_s: Annotated[float, typer.Option(min=0, help="Begin a new file after this time; 0: never.")] = 0.0,
    for_s: ForS = 0.0,
    vehicle: Vehicle = VEHICLE,
    bus: Bus = BUS,
    certs: Certs = None,
) -> None:
    """Record TOPICS from the bus until Ctrl-C. Example: companion record --out flight.mcap

    Opens in Foxglove, PlotJuggler, Rerun and with `ros2 bag`. If it is killed, `companion export
    torn.mcap --mcap whole.mcap` saves all but its last second.
    Exit code 0: recorded; 1: nothing was said, or the disk is full; 3: no bus.
    """
    path = out or Path(f"{datetime.now():%Y-%m-%d-%H%M%S}.mcap")
    console = Console(stderr=True)
    with Desk(bus, certs=certs) as desk, stopping() as stopped:
        recorder = Recorder(path, split_bytes=split_mb * 1_000_000, split_s=split_s)
        try:
            recording = BusRecording(desk, recorder, wanted=topics or (), vehicle=vehicle)
            end_s = time.monotonic() + (for_s or float("inf"))
            with console.status(f"recording into {path}") as status:
                while not stopped.is_set() and not recorder.failure and time.monotonic() < end_s:
                    recording.look()
                    heard = f"{sum(recorder.written.values())} messages on {len(recording.topics)} topics"
                    status.update(f"recording into {path}: {heard}")
                    stopped.wait(min(LOOK_S, max(0.0, end_s - time.monotonic())))
        finally:
            recorder.close()
    _tell(recorder, recording, console)


def _tell(recorder: Recorder, recording: BusRecording, console: Console) -> None:
    files = ", ".join(map(str, recorder.files))
    size = sum(f.stat().st_size for f in recorder.files) / 1e6
    count, topics = sum(recorder.written.values()), len(recorder.written)
    console.print(f"{files}: {count} messages on {topics} topics, {size:.1f} MB", highlight=False, soft_wrap=True)
    for topic, number in recorder.dropped.items():
        console.print(f"[yellow]{topic}: {number} messages lost, the disk was too slow[/]", highlight=False)
    for name, why in recording.refused.items():
        console.print(f"[yellow]{name} is not recorded: {why}[/]", highlight=False, soft_wrap=True)
    if recorder.failure:
        raise CompanionError(recorder.failure)
    if not count:
        raise CompanionError("nothing was said in the time: `companion topic list` shows what there is")
