"""`companion param`: the autopilot's parameters, beside a flight or without one."""

from __future__ import annotations

from fnmatch import fnmatchcase
from pathlib import Path
from typing import Annotated

import msgspec
import typer
from rich.console import Console
from rich.table import Table

from companion.cli.bus_options import say, warn
from companion.core.errors import CompanionError, InputError, LinkError
from companion.runtime.ports.ground_station import FIRST_HEARTBEAT_S
from companion.runtime.ports.parameter_file import Difference, Entry, differences, read_entries, write_text
from companion.runtime.ports.parameters import (
    Parameters,
    Refused,
    Value,
    open_parameters,
    read_value,
    shown,
)

VEHICLE = "udpin://127.0.0.1:14550"
Vehicle = Annotated[str, typer.Option("--vehicle", help="MAVLink URL; the ground station's, not the companion's.")]
WaitS = Annotated[float, typer.Option("--wait-s", min=0.5, max=600, help="For the first heartbeat.")]
Json = Annotated[bool, typer.Option("--json", help="Print JSON, one object per line.")]
Name = Annotated[str, typer.Argument(metavar="NAME", help="Parameter, such as MPC_XY_P.")]
FileIn = Annotated[Path, typer.Argument(metavar="FILE", help="As QGroundControl or MAVProxy writes it.")]


def get(name: Name, vehicle: Vehicle = VEHICLE, wait_s: WaitS = FIRST_HEARTBEAT_S, as_json: Json = False) -> None:
    """Print one value. Example: companion param get MPC_XY_P

    Exit code 2: no such parameter; 3: no vehicle.
    """
    with open_parameters(vehicle, wait_s=wait_s) as parameters:
        value = parameters.get(name)
    say(_json(name, value) if as_json else shown(value))


def set_(
    name: Name,
    value: Annotated[str, typer.Argument(metavar="VALUE", help="An integer where the vehicle has one.")],
    vehicle: Vehicle = VEHICLE,
    wait_s: WaitS = FIRST_HEARTBEAT_S,
    as_json: Json = False,
) -> None:
    """Set one value and read it back. Example: companion param set MPC_XY_P 0.7; before a negative one put --

    Exit code 1: the vehicle kept another value; 2: no such parameter, or not of its type; 3: no vehicle.
    """
    with open_parameters(vehicle, wait_s=wait_s) as parameters:
        before = parameters.get(name)
        kept = parameters.set(name, read_value(value, before, name))
    say(_json(name, kept, before=before) if as_json else f"{name}: {shown(before)} -> {shown(kept)}")


def list_parameters(
    pattern: Annotated[str, typer.Argument(metavar="[PATTERN]", help="Such as 'MPC_*'; else every name.")] = "*",
    changed: Annotated[
        Path | None, typer.Option("--changed", metavar="FILE", help="Only what differs from this file.")
    ] = None,
    vehicle: Vehicle = VEHICLE,
    wait_s: WaitS = FIRST_HEARTBEAT_S,
    as_json: Json = False,
) -> None:
    """List the parameters. Example: companion param list 'EKF2_*' --changed before.params

    The vehicle does not tell defaults: --changed compares with a file of `companion param save`.
    Exit code 2: no name fits, or the file is wrong; 3: no vehicle.
    """
    entries = _read(changed) if changed else None
    with open_parameters(vehicle, wait_s=wait_s) as parameters:
        values = parameters.all()
    chosen = {name: v for name, v in values.items() if fnmatchcase(name, pattern.upper())}
    if not chosen:
        raise InputError(f"none of {len(values)} names fits {pattern!r}", valid="a name with * and ?, quoted")
    if entries is not None:
        found = differences(entries, values, file=str(changed))
        _show_differences([d for d in found if d.name in chosen], as_json=as_json)
    elif as_json:
        for name, value in chosen.items():
            say(_json(name, value))
    else:
        width = max(map(len, chosen))
        for name, value in chosen.items():
            say(f"{name:<{width}}  {shown(value)}")


def save(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="Where to; an old file is replaced.")],
    vehicle: Vehicle = VEHICLE,
    wait_s: WaitS = FIRST_HEARTBEAT_S,
) -> None:
    """Write all parameters as QGroundControl does. Example: companion param save before.params

    Exit code 2: the file cannot be written; 3: no vehicle.
    """
    with open_parameters(vehicle, wait_s=wait_s) as parameters:
        values = parameters.all()
    try:
        file.write_text(write_text(values), encoding="utf-8")
    except OSError as error:
        raise InputError(f"cannot be written: {error.strerror}", file=str(file)) from error
    say(f"{file}: {len(values)} parameters")


def load(
    file: FileIn,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Show what would change; set nothing.")] = False,
    vehicle: Vehicle = VEHICLE,
    wait_s: WaitS = FIRST_HEARTBEAT_S,
    as_json: Json = False,
) -> None:
    """Set what differs from FILE, each value read back. Example: companion param load before.params --dry-run

    A file with one unknown name or wrong value changes nothing at all.
    Exit code 1: the vehicle kept other values; 2: the file is wrong; 3: no vehicle.
    """
    entries = _read(file)
    with open_parameters(vehicle, wait_s=wait_s) as parameters:
        found = differences(entries, parameters.all(), file=str(file))
        _show_differences(found, as_json=as_json)
        if dry_run:
            return
        refused = _set_all(parameters, found)
    if refused:
        raise CompanionError(f"{refused} of {len(found)} parameters were not taken")
    if not as_json:
        say(f"set and read back: {len(found)} of {len(entries)}; the others were so already")


def _read(file: Path) -> list[Entry]:
    try:
        return read_entries(file.read_text(encoding="utf-8"), file=str(file))
    except (OSError, UnicodeDecodeError) as error:
        why = "is not UTF-8 text" if isinstance(error, UnicodeDecodeError) else f"cannot be read: {error.strerror}"
        raise InputError(why, file=str(file), valid="a file of companion param save") from error


def _set_all(parameters: Parameters, found: list[Difference]) -> int:
    """Set one after the other; returns how many were refused."""
    refused = 0
    for done, d in enumerate(found):
        try:
            parameters.set(d.name, d.file)
        except Refused as error:
            refused += 1
            warn(str(error))
        except LinkError as error:
            raise LinkError(f"{error}; {done} of {len(found)} parameters were set before") from error
    return refused


def _show_differences(found: list[Difference], *, as_json: bool) -> None:
    if as_json:
        for d in found:
            say(msgspec.json.encode({"name": d.name, "vehicle": d.vehicle, "file": d.file}).decode())
        return
    if not found:
        say("nothing differs from the file")
        return
    table = Table("name", "vehicle", "file", box=None, pad_edge=False)
    for d in found:
        table.add_row(d.name, shown(d.vehicle), shown(d.file))
    Console(soft_wrap=True).print(table, highlight=False)


def _json(name: str, value: Value, **more: Value) -> str:
    kind = "int" if isinstance(value, int) else "float"
    return msgspec.json.encode({"name": name, "value": value, "type": kind, **more}).decode()
