"""`companion service`: list and call services of any ROS 2 machine on the bus, without ROS."""

from __future__ import annotations

from typing import Annotated

import msgspec
import typer

from companion.cli.bus_options import BUS, VEHICLE, Bus, Certs, Json, Vehicle, say
from companion.runtime.tools.call import call, find_service
from companion.runtime.tools.desk import Desk
from companion.runtime.tools.names import full_name, services_of
from companion.runtime.tools.show import Style, as_json, as_yaml
from companion.runtime.tools.values import parse_values, short_name


def list_services(
    show_types: Annotated[bool, typer.Option("-t", "--show-types", help="Types beside the names.")] = False,
    everything: Annotated[bool, typer.Option("--all", help="Hidden services, too.")] = False,
    bus: Bus = BUS,
    certs: Certs = None,
    as_json_: Json = False,
) -> None:
    """List the services on the bus. Example: companion service list -t

    Exit code 3: no bus is there.
    """
    with Desk(bus, certs=certs) as desk:
        views = [v for v in services_of(desk.entities()) if v.givers and (everything or not v.hidden)]
    for v in views:
        if as_json_:
            servers = [full_name(e) for e in v.givers]
            say(msgspec.json.encode({"name": v.name, "types": v.types, "servers": servers}).decode())
        else:
            say(f"{v.name} [{', '.join(v.types)}]" if show_types else v.name)


def call_service(
    name: Annotated[str, typer.Argument(metavar="NAME", help="Service, such as /talker/get_parameters.")],
    type_: Annotated[str, typer.Argument(metavar="TYPE", help="Such as std_srvs/srv/SetBool; '' for the server's.")],
    values: Annotated[str, typer.Argument(metavar="VALUES", help="YAML or JSON; what is missing is zero.")] = "{}",
    timeout_s: Annotated[float, typer.Option(min=0.01, help="Wait at most so long for the answer.")] = 5.0,
    vehicle: Vehicle = VEHICLE,
    bus: Bus = BUS,
    certs: Certs = None,
    as_json_: Json = False,
) -> None:
    """Call a service once. Example: companion service call /talker/get_parameters '' '{names: [use_sim_time]}'

    Exit code 1: no answer, or an error; 2: no such service, type or field; 3: no bus.
    """
    request = parse_values(values)
    with Desk(bus, certs=certs) as desk:
        found, kind = find_service(desk, name, short_name(type_, "srv"), vehicle=vehicle)
        answer = call(desk, found, kind, request, timeout_s=timeout_s)
    say(as_json(answer) if as_json_ else as_yaml(answer, Style()).removesuffix("---").rstrip())
