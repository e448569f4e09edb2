"""`companion topic pub`: publish what a user typed."""

from __future__ import annotations

from typing import Annotated

import typer

from companion.cli.bus_options import BUS, VEHICLE, Bus, Certs, ForS, Json, Vehicle, say, stopping
from companion.runtime.tools.desk import Desk
from companion.runtime.tools.ear import Limits
from companion.runtime.tools.publish import await_subscriptions, publish, qos, topic_to_publish, type_to_publish
from companion.runtime.tools.show import as_json
from companion.runtime.tools.values import parse_values, short_name, stamped

KEEP_ALIVE_S = 0.1  # what was put last must still leave


def pub(
    name: Annotated[str, typer.Argument(metavar="NAME", help="Topic, such as /drone1/wind.")],
    type_: Annotated[str, typer.Argument(metavar="TYPE", help="Such as geometry_msgs/msg/TwistStamped.")],
    values: Annotated[str, typer.Argument(metavar="VALUES", help="YAML or JSON; what is missing is zero.")] = "{}",
    rate: Annotated[float, typer.Option("--rate", "-r", min=0.001, max=1000, help="Messages per second.")] = 1.0,
    once: Annotated[bool, typer.Option("--once", "-1", help="One message, then end.")] = False,
    times: Annotated[int, typer.Option("--times", "-t", min=0, help="So many messages, then end.")] = 0,
    for_s: ForS = 0.0,
    wait: Annotated[
        int, typer.Option("--wait-matching-subscriptions", "-w", min=0, help="Begin when so many listen.")
    ] = 1,
    wait_s: Annotated[float, typer.Option("--wait-s", min=0, help="Wait at most so long for them.")] = 5.0,
    reliability: Annotated[str, typer.Option("--qos-reliability", help="reliable or best_effort.")] = "reliable",
    durability: Annotated[str, typer.Option("--qos-durability", help="volatile or transient_local.")] = "volatile",
    depth: Annotated[int, typer.Option("--qos-depth", min=1, help="Kept for late joiners, if transient_local.")] = 10,
    vehicle: Vehicle = VEHICLE,
    bus: Bus = BUS,
    certs: Certs = None,
    as_json_: Json = False,
    quiet: Annotated[bool, typer.Option("--quiet", help="Print nothing but errors.")] = False,
) -> None:
    """Publish VALUES. Example: companion topic pub /wind geometry_msgs/msg/Vector3 '{x: 2}' -r 10

    A header that is `auto` and a time that is `now` get the time of each message.
    Exit code 2: no such type or field; 3: nobody listens, or no bus.
    """
    values_ = parse_values(values)
    with Desk(bus, certs=certs) as desk, stopping() as stopped:
        everyone = desk.entities()
        topic = topic_to_publish(everyone, name, vehicle)
        kind = type_to_publish(desk, everyone, topic, short_name(type_, "msg"))
        kind.complete(stamped(kind, values_, 0))  # refused before anybody is waited for
        publisher = desk.node.publisher(topic, kind, qos(reliability, durability, depth))
        await_subscriptions(desk, publisher, topic, kind, wanted=wait, timeout_s=wait_s, stopped=stopped)
        limits = Limits(1 if once else times, for_s)
        for k, sent in enumerate(publish(desk, publisher, kind, values_, rate_hz=rate, limits=limits, stopped=stopped)):
            if not quiet:
                say(as_json(sent) if as_json_ else f"{topic} #{k + 1}: {as_json(sent, arrays=False)}")
        stopped.wait(KEEP_ALIVE_S)
