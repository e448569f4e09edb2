"""`companion export`: a recorded flight as an MCAP file for Foxglove, RViz, PlotJuggler and Rerun."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from companion.core.errors import InputError
from companion.runtime.export import export as export_flight
from companion.runtime.mcap_file import recover


def export(
    flight: Annotated[Path, typer.Argument(help="Folder of a flight, one of its logs, or a torn MCAP file.")],
    mcap: Annotated[Path, typer.Option(help="The file to write.")],
    compute: Annotated[
        bool, typer.Option(help="Replay the flight, so that scans and maps that are not stored are there, too.")
    ] = False,
    maps: Annotated[bool, typer.Option(help="Whole local maps: 100 MB per flown second.")] = False,
    vehicle: Annotated[str, typer.Option(help="Namespace of the topics.")] = "drone1",
) -> None:
    """Write FLIGHT as MCAP. Example: companion export flights/demo --mcap demo.mcap

    Our topics and /tf, odom, path, plan, cloud, /rosout for viewers. Of an MCAP file whose recorder
    was killed, everything that is whole is saved.
    """
    console, started = Console(), time.perf_counter()
    if flight.suffix == ".mcap":
        if flight.resolve() == mcap.resolve():
            raise InputError("would overwrite what it reads", field="--mcap", valid="another file")
        console.print(f"{mcap}: {recover(flight, mcap)} messages saved", highlight=False)
        return
    with console.status("writing"):
        done = export_flight(flight, mcap, vehicle=vehicle, compute=compute, maps=maps)
    size, wall_s = mcap.stat().st_size / 1e6, time.perf_counter() - started
    console.print(f"{mcap}: {done.messages} messages, {size:.1f} MB, in {wall_s:.1f} s", highlight=False)
    if done.unknown:
        missing = ", ".join(f"{name} ({count})" for name, count in done.unknown.items())
        console.print(
            f"not stored in the log: {missing}; a flight flown with --record and --compute have them", highlight=False
        )
