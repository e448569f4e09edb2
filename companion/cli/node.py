"""`companion node`: which nodes are on the bus, and what each of them speaks."""

from __future__ import annotations

from typing import Annotated

import msgspec
import typer

from companion.cli.bus_options import BUS, VEHICLE, Bus, Certs, Json, Vehicle, say, warn
from companion.runtime.tools.desk import Desk
from companion.runtime.tools.names import find, is_hidden, nodes_of
from companion.runtime.wire.keys import Entity, Kind

PARTS: tuple[tuple[str, Kind], ...] = (
    ("Subscribers", "MS"), ("Publishers", "MP"), ("Service Servers", "SS"), ("Service Clients", "SC"),
)  # fmt: skip


def list_nodes(
    everything: Annotated[bool, typer.Option("--all", "-a", help="Hidden nodes, too.")] = False,
    bus: Bus = BUS,
    certs: Certs = None,
    as_json_: Json = False,
) -> None:
    """List the nodes on the bus. Example: companion node list

    Exit code 3: no bus is there.
    """
    with Desk(bus, certs=certs) as desk:
        nodes = nodes_of(desk.entities())
    for name, entities in nodes.items():
        if is_hidden(name) and not everything:
            continue
        count = sum(e.kind == "NN" for e in entities)
        if as_json_:
            counts = {title.lower().replace(" ", "_"): sum(e.kind == k for e in entities) for title, k in PARTS}
            say(msgspec.json.encode({"name": name, "nodes": count, **counts}).decode())
        else:
            say(name)
            if count > 1:
                warn(f"{count} nodes bear the name {name}")


def info(
    name: Annotated[str, typer.Argument(metavar="NODE", help="Node, such as /drone1/LioNode or LioNode.")],
    vehicle: Vehicle = VEHICLE,
    bus: Bus = BUS,
    certs: Certs = None,
    as_json_: Json = False,
) -> None:
    """Show what a node publishes, subscribes to, serves and calls. Example: companion node info LioNode

    Exit code 2: no such node; 3: no bus.
    """
    with Desk(bus, certs=certs) as desk:
        nodes = nodes_of(desk.entities())
    found = find(name, list(nodes), vehicle=vehicle, what="node")
    if as_json_:
        parts = {title.lower().replace(" ", "_"): dict(_spoken(nodes[found], kind)) for title, kind in PARTS}
        say(msgspec.json.encode({"name": found, **parts}).decode())
        return
    say(found)
    for title, kind in PARTS:
        say(f"  {title}:")
        for topic, type_ in _spoken(nodes[found], kind):
            say(f"    {topic}: {type_}")


def _spoken(entities: list[Entity], kind: Kind) -> list[tuple[str, str]]:
    return sorted({(e.topic, e.type) for e in entities if e.kind == kind})
