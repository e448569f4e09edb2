"""`companion map locate`: where in a saved map a recorded flight was."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated

import msgspec
import typer
from rich.console import Console

from companion.core.errors import InputError
from companion.runtime.locate import Found, locate
from companion.runtime.map_file import READABLE, read_map


def locate_flight(
    file: Annotated[Path, typer.Argument(help=f"A map ({', '.join(READABLE)}), or the folder of a flight.")],
    flight: Annotated[Path, typer.Argument(help="Folder of a flight flown with --record.")],
    at: Annotated[float, typer.Option(min=0.0, help="Second of the flight at which to begin; it must be in the air.")],
    windows: Annotated[int, typer.Option(min=1, max=60, help="Seconds of scans to look at, at most.")] = 3,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
) -> None:
    """Find FLIGHT in the map FILE. Example: companion map locate flights/yesterday flights/today --at 20

    Nothing of what FLIGHT knew of its place is used, apart from its own motion. Exit code 1: it cannot be told.
    """
    if not flight.is_dir():
        raise InputError("no such folder", file=str(flight), valid="the folder of a flight")
    found = locate(read_map(file), flight, at_s=at, most_windows=windows)
    text = msgspec.json.encode(_facts(found)).decode() if as_json else _sentence(found)
    Console(highlight=False, soft_wrap=True).print(text, markup=False)
    if found.located is None:
        raise typer.Exit(1)


def _facts(found: Found) -> dict[str, object]:
    """In the map's frame; `yaw_map_odom_rad` turns the flight's odom into the map."""
    facts: dict[str, object] = {
        "found": found.located is not None,
        "windows": found.windows,
        "time_s": round(found.stamp_ns * 1e-9, 2),
        "p_odom": [round(float(x), 3) for x in found.p_odom],
    }
    if found.located is not None:
        R = found.located.R
        facts["p_map"] = [round(float(x), 3) for x in found.located.p]
        facts["yaw_map_odom_rad"] = round(math.atan2(R[1, 0], R[0, 0]), 4)
        facts["near"] = round(found.located.near, 3)
        facts["by"] = found.located.by
    return facts


def _sentence(found: Found) -> str:
    time_s = found.stamp_ns * 1e-9
    if found.located is None:
        return (
            f"not found in {found.windows} s of scans up to {time_s:.1f} s: the place is not in this map, or not sure"
        )
    x, y, z = found.located.p
    yaw = math.degrees(math.atan2(found.located.R[1, 0], found.located.R[0, 0]))
    return (
        f"at {time_s:.1f} s at map ({x:.2f}, {y:.2f}, {z:.2f}) m, odom turned by {yaw:.1f} deg: known by "
        f"{found.located.by}, {found.located.near:.0%} of the points fit, {found.windows} s of scans"
    )
