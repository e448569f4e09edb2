"""`companion mission`: a dry run of a mission file, and its way into an autopilot's memory."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import msgspec
import typer
from rich import box
from rich.console import Console
from rich.table import Table

from companion.autopilot.mission_items import described
from companion.cli.bus_options import say
from companion.cli.flight_input import read_text
from companion.cli.param import VEHICLE, Vehicle, WaitS
from companion.core.errors import InputError
from companion.mission.estimate import StepEstimate, estimate, total_time_s
from companion.mission.model import Mission, parse_mission
from companion.mission.on_earth import Origin, places_of
from companion.runtime.ports.ground_station import FIRST_HEARTBEAT_S
from companion.runtime.ports.mission_transfer import MissionTransfer, items_of


def check(
    mission: Annotated[Path, typer.Argument(help="Mission YAML, such as missions/first_flight.yaml.")],
    power_w: Annotated[float, typer.Option(min=1, help="Power in hover, W, for the energy.")] = 250.0,
    battery_wh: Annotated[float, typer.Option(min=1, help="Full battery, Wh.")] = 77.0,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
    quiet: Annotated[bool, typer.Option("--quiet", help="Print nothing but errors.")] = False,
) -> None:
    """Check MISSION and say what it takes. Example: companion mission check missions/hop.yaml

    Exit code 0: can be flown; 2: wrong, with file, line and the valid choices.
    """
    parsed = parse_mission(read_text(mission), file=str(mission))
    rows = estimate(parsed)
    share = total_time_s(rows) / 3600 * power_w / battery_wh
    if as_json:
        typer.echo(_json(parsed, rows, share))
    elif not quiet:
        _print(parsed, rows, share)


def upload(
    mission: Annotated[Path, typer.Argument(help="Mission YAML of takeoff, goto, survey, hover, return, land.")],
    origin: Annotated[str, typer.Option(metavar="LAT,LON,HEADING", help="Home, degrees; heading: where x points.")],
    vehicle: Vehicle = VEHICLE,
    wait_s: WaitS = FIRST_HEARTBEAT_S,
) -> None:
    """Store MISSION in the autopilot, which flies it by GPS, without a companion's eyes.

    Example: companion mission upload missions/hop.yaml --origin 47.3977,8.5456,90

    Exit code 1: the autopilot refuses it; 2: it has no places on Earth; 3: no vehicle.
    """
    parsed = parse_mission(read_text(mission), file=str(mission))
    items = items_of(places_of(parsed, _origin(origin)))
    with MissionTransfer(vehicle, wait_s=wait_s) as transfer:
        transfer.upload(items)
    say(f"{parsed.name}: {len(items)} items stored and read back; nothing in them knows of trees")


def download(
    vehicle: Vehicle = VEHICLE,
    wait_s: WaitS = FIRST_HEARTBEAT_S,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON, one item per line.")] = False,
) -> None:
    """Print the mission that the autopilot has stored. Example: companion mission download

    Exit code 3: no vehicle.
    """
    with MissionTransfer(vehicle, wait_s=wait_s) as transfer:
        items = transfer.download()
    for number, item in enumerate(items, 1):
        say(msgspec.json.encode(item._asdict()).decode() if as_json else f"{number:3d}  {described(item)}")
    if not items and not as_json:
        say("no mission is stored")


def _origin(text: str) -> Origin:
    try:
        return Origin(*(float(part) for part in text.split(",")))
    except (TypeError, ValueError):
        raise InputError(f"{text!r} is no place", field="--origin", valid="LAT,LON,HEADING in degrees") from None


def _json(mission: Mission, rows: tuple[StepEstimate, ...], share: float) -> str:
    report = {
        "name": mission.name,
        "steps": [asdict(row) for row in rows],
        "length_m": sum(row.length_m for row in rows),
        "time_s": total_time_s(rows),
        "battery_share": share,
    }
    return msgspec.json.encode(report).decode()


def _print(mission: Mission, rows: tuple[StepEstimate, ...], share: float) -> None:
    heads = ("step", "do", "goals", "length\nm", "time\ns", "x\nm", "y\nm", "height\nm")
    table = Table(box=box.SIMPLE_HEAD, show_edge=False, pad_edge=False)
    for number, head in enumerate(heads):
        table.add_column(head, justify="left" if number < 2 else "right", no_wrap=True)
    for row in rows:
        spans = [f"{low:.0f}..{high:.0f}" for low, high in zip(row.low[:2], row.high[:2], strict=True)]
        figures = (f"{row.length_m:.1f}", f"{row.time_s:.0f}")
        height = f"{row.low[2]:.1f}..{row.high[2]:.1f}"
        table.add_row(row.id, row.do, str(row.goals), *figures, *spans, height)
    console, reserve = Console(), mission.failsafe.battery.reserve
    console.print(f"[bold]{mission.name}[/] {mission.description}")
    console.print(table)
    total = f"{sum(r.length_m for r in rows):.0f} m, {total_time_s(rows):.0f} s"
    console.print(f"{total}, about {share:.0%} of the battery; home frame, no obstacles, no wind")
    if share > 1 - reserve:
        console.print(f"[yellow]note:[/] leaves less than the reserve of {reserve:.0%}")


def table(
    missions: Annotated[list[Path], typer.Argument(help="Mission files.")],
) -> None:
    """Print a Markdown table of MISSIONS. Example: companion mission table missions/*.yaml"""
    typer.echo("| mission | what it does | steps | length, m | time, s |\n|---|---|--:|--:|--:|")
    for file in sorted(missions):
        parsed = parse_mission(read_text(file), file=str(file))
        rows = estimate(parsed)
        figures = f"{len(rows)} | {sum(r.length_m for r in rows):.0f} | {total_time_s(rows):.0f}"
        typer.echo(f"| [{file.name}]({file.name}) | {parsed.description} | {figures} |")
