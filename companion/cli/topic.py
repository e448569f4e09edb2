"""`companion topic`: see, measure and publish topics of any ROS 2 machine on the bus, without ROS."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Annotated, Any

import msgspec
import typer
from rich.console import Console
from rich.table import Table

from companion.cli.bus_options import (
    BUS,
    VEHICLE,
    Bus,
    Certs,
    Count,
    ForS,
    Json,
    Vehicle,
    nothing_heard,
    say,
    stopping,
    warn,
)
from companion.runtime.tools.desk import Desk
from companion.runtime.tools.ear import Heard, Limits, listen
from companion.runtime.tools.kinds import Named, message_type
from companion.runtime.tools.meters import BandwidthMeter, DelayMeter, Meter, RateMeter
from companion.runtime.tools.names import View, find_view, full_name, topics_of
from companion.runtime.tools.show import Style, as_csv, as_json, as_yaml, field_path, part_of
from companion.runtime.wire import WireError, WireType
from companion.runtime.wire.keys import Entity, gid_of, token

Name = Annotated[str, typer.Argument(metavar="NAME", help="Topic, such as /drone1/sensors/imu or sensors/imu.")]
Window = Annotated[int, typer.Option("--window", "-w", min=2, help="Newest messages that count.")]


def list_topics(
    show_types: Annotated[bool, typer.Option("-t", "--show-types", help="Types beside the names.")] = False,
    verbose: Annotated[bool, typer.Option("-v", "--verbose", help="Types and counts.")] = False,
    everything: Annotated[bool, typer.Option("--all", help="Hidden topics, too.")] = False,
    bus: Bus = BUS,
    certs: Certs = None,
    as_json_: Json = False,
) -> None:
    """List the topics on the bus. Example: companion topic list -t

    Exit code 3: no bus is there.
    """
    with Desk(bus, certs=certs) as desk:
        views = [v for v in topics_of(desk.entities()) if everything or not v.hidden]
    if as_json_:
        for v in views:
            counts = {"publishers": len(v.givers), "subscriptions": len(v.takers)}
            say(msgspec.json.encode({"name": v.name, "types": v.types, **counts}).decode())
    elif verbose:
        table = Table("topic", "type", "publishers", "subscriptions", box=None, pad_edge=False)
        for v in views:
            table.add_row(v.name, ", ".join(v.types), str(len(v.givers)), str(len(v.takers)))
        Console(soft_wrap=True).print(table)
    else:
        for v in views:
            say(f"{v.name} [{', '.join(v.types)}]" if show_types else v.name)


def info(
    name: Name,
    verbose: Annotated[bool, typer.Option("-v", "--verbose", help="Nodes, ids and QoS of every endpoint.")] = False,
    vehicle: Vehicle = VEHICLE,
    bus: Bus = BUS,
    certs: Certs = None,
    as_json_: Json = False,
) -> None:
    """Show who publishes and who subscribes. Example: companion topic info sensors/imu -v

    Exit code 2: no such topic; 3: no bus.
    """
    with Desk(bus, certs=certs) as desk:
        view = find_view(topics_of(desk.entities()), name, vehicle=vehicle)
    if as_json_:
        publishers, subscriptions = ([_described(e) for e in ends] for ends in (view.givers, view.takers))
        whole = {"name": view.name, "types": view.types, "publishers": publishers, "subscriptions": subscriptions}
        say(msgspec.json.encode(whole).decode())
        return
    say(f"Topic: {view.name}\nType: {', '.join(view.types)}")
    for title, ends in (("Publisher", view.givers), ("Subscription", view.takers)):
        say(f"{title} count: {len(ends)}")
        for end in ends if verbose else ():
            say("\n" + "\n".join(f"  {key}: {value}" for key, value in _described(end).items()))
        if verbose:
            say("")


def _described(end: Entity) -> dict[str, Any]:
    qos = end.qos
    infinite = "infinite"
    return {
        "node": full_name(end),
        "type": end.type,
        "type_hash": end.type_hash,
        "gid": gid_of(token(end)).hex("."),
        "reliability": "reliable" if qos.reliable else "best_effort",
        "durability": "transient_local" if qos.transient_local else "volatile",
        "history": "keep_all" if qos.keep_all else f"keep_last ({qos.depth})",
        "deadline": infinite if qos.deadline_ns is None else f"{qos.deadline_ns * 1e-9:g} s",
        "lifespan": infinite if qos.lifespan_ns is None else f"{qos.lifespan_ns * 1e-9:g} s",
    }


def echo(
    name: Name,
    once: Annotated[bool, typer.Option("--once", "-1", help="One message, then end.")] = False,
    count: Count = 0,
    for_s: ForS = 0.0,
    field: Annotated[str, typer.Option(help="Only this part, such as header.stamp or p_odom[2].")] = "",
    arrays: Annotated[bool, typer.Option("--arr/--no-arr", help="Contents of arrays, or their sizes alone.")] = True,
    full: Annotated[bool, typer.Option("--full-length", "-f", help="Long arrays and strings whole.")] = False,
    csv: Annotated[bool, typer.Option("--csv", help="One line of values per message.")] = False,
    as_json_: Json = False,
    raw: Annotated[bool, typer.Option("--raw", help="The bytes; needs no type.")] = False,
    vehicle: Vehicle = VEHICLE,
    bus: Bus = BUS,
    certs: Certs = None,
) -> None:
    """Print messages as they come. Example: companion topic echo estimation/odometry --field p_odom

    Long arrays are cut after 128 elements, except in JSON.
    Exit code 1: no message came in the time; 2: no such topic or field; 3: no bus.
    """
    with Desk(bus, certs=certs) as desk, stopping() as stopped:
        view, everyone = _found(desk, name, vehicle)
        kind = None if raw else message_type(desk, view.givers or view.takers, everyone)
        path = field_path(field, kind) if field and kind else ()
        shape = _Shape(Style(arrays, full), path, "json" if as_json_ else "csv" if csv else "yaml")
        ear = listen(desk, view, kind or _named(view))
        heard_any = False
        for heard in ear.until(stopped, Limits(1 if once else count, for_s)):
            if heard is not None:
                heard_any = True
                _print(heard, kind, shape)
        if ear.left_out:
            warn(f"{ear.left_out} messages were left out: the output was too slow for them")
        if not heard_any and (error := nothing_heard(view.name, stopped)):
            raise error


@dataclass(frozen=True, slots=True)
class _Shape:
    style: Style
    path: tuple[str | int, ...]
    text: str


def _print(heard: Heard, kind: WireType | None, shape: _Shape) -> None:
    if kind is None:
        say(as_json({"raw": heard.payload.hex()}) if shape.text == "json" else f"{heard.payload!r}\n---")
        return
    try:
        value = part_of(kind.decode(heard.payload), shape.path)
    except WireError as error:
        warn(f"one message is none: {error}")
        return
    if shape.text == "json":
        say(as_json(value, arrays=shape.style.arrays))
    else:
        say((as_csv if shape.text == "csv" else as_yaml)(value, shape.style))


def hz(
    name: Name,
    window: Window = 10_000,
    count: Count = 0,
    for_s: ForS = 0.0,
    vehicle: Vehicle = VEHICLE,
    bus: Bus = BUS,
    certs: Certs = None,
    as_json_: Json = False,
) -> None:
    """Measure a topic's rate, once per second. Example: companion topic hz sensors/imu --for-s 5

    Exit code 1: no message came in the time; 2: no such topic; 3: no bus.
    """
    with Desk(bus, certs=certs) as desk:
        view, _ = _found(desk, name, vehicle)
        _measure(desk, view, _named(view), RateMeter(window), Limits(count, for_s), as_json_=as_json_)


def bw(
    name: Name,
    window: Window = 100,
    count: Count = 0,
    for_s: ForS = 0.0,
    vehicle: Vehicle = VEHICLE,
    bus: Bus = BUS,
    certs: Certs = None,
    as_json_: Json = False,
) -> None:
    """Measure a topic's bytes per second, once per second. Example: companion topic bw sensors/lidar --for-s 5

    Exit code 1: no message came in the time; 2: no such topic; 3: no bus.
    """
    with Desk(bus, certs=certs) as desk:
        view, _ = _found(desk, name, vehicle)
        _measure(desk, view, _named(view), BandwidthMeter(window), Limits(count, for_s), as_json_=as_json_)


def delay(
    name: Name,
    window: Window = 10_000,
    count: Count = 0,
    for_s: ForS = 0.0,
    vehicle: Vehicle = VEHICLE,
    bus: Bus = BUS,
    certs: Certs = None,
    as_json_: Json = False,
) -> None:
    """Measure how old messages are when they come. Example: companion topic delay estimation/odometry --for-s 5

    Exit code 1: no message, or no stamps in it; 2: no such topic; 3: no bus.
    """
    with Desk(bus, certs=certs) as desk:
        view, everyone = _found(desk, name, vehicle)
        kind = message_type(desk, view.givers or view.takers, everyone)
        meter = DelayMeter(kind.decode, window)
        _measure(desk, view, kind, meter, Limits(count, for_s), as_json_=as_json_)


def _measure(desk: Desk, view: View, kind: WireType | Named, meter: Meter, limits: Limits, *, as_json_: bool) -> None:
    """Report once per second, and once more at the end."""
    ear, fresh = listen(desk, view, kind), 0
    tell = partial(_report, meter, as_json_=as_json_)
    with stopping() as stopped:
        for heard in ear.until(stopped, limits):
            if heard is not None:
                fresh += _added(meter, heard)
            else:
                tell(fresh)
                fresh = 0
        if not meter.report() and (error := nothing_heard(view.name, stopped)):
            raise error
        if fresh:
            tell(fresh)


def _added(meter: Meter, heard: Heard) -> bool:
    try:
        meter.add(heard)
    except WireError as error:
        warn(f"one message is none: {error}")
        return False
    return True


def _report(meter: Meter, fresh: int, *, as_json_: bool) -> None:
    report = meter.report()
    if as_json_:
        say(as_json({**report, "new": fresh}))
    else:
        say(meter.line(report) if fresh and report else "no new messages")


def _found(desk: Desk, name: str, vehicle: str) -> tuple[View, list[Entity]]:
    everyone = desk.entities()
    return find_view(topics_of(everyone), name, vehicle=vehicle), everyone


def _named(view: View) -> Named:
    first = (view.givers or view.takers)[0]
    others = {e.type for e in (*view.givers, *view.takers) if e.type_hash != first.type_hash}
    if others:
        warn(f"{view.name} is spoken in several types; this is about {first.type} alone")
    return Named(first.type, first.type_hash)
