"""The `companion` command: mounts the command groups and turns user errors into one line."""

from __future__ import annotations

import sys

import typer
from rich.console import Console

import companion
from companion.cli import (
    config,
    doctor,
    export,
    fly,
    keys,
    mavlink,
    mission,
    node,
    odometry,
    record,
    replay,
    run,
    service,
    sim,
    top,
    topic,
    topic_pub,
)
from companion.core.errors import CompanionError

app = typer.Typer(
    name="companion",
    help="Fly, check and inspect Understory missions. Example: companion fly missions/first_flight.yaml",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)
app.command("fly")(fly.fly)
app.command("run")(run.run)
app.command("sim")(sim.sim)
app.command("record")(record.record)
app.command("replay")(replay.replay)
app.command("export")(export.export)
app.command("top")(top.top)
app.command("doctor")(doctor.doctor)
app.command("odometry")(odometry.odometry)


def _group(name: str, help_text: str, **commands: object) -> None:
    group = typer.Typer(help=help_text, no_args_is_help=True)
    for command, function in commands.items():
        group.command(command)(function)  # type: ignore[type-var]
    app.add_typer(group, name=name)


_group("mission", "Check mission files.", check=mission.check, table=mission.table)
_group("config", "Show the configuration.", dump=config.dump)
_group("keys", "Make and check MAVLink signing keys.", new=keys.new, show=keys.show)
_group("mavlink", "Look into MAVLink logs.", inspect=mavlink.inspect)

_group(
    "topic",
    "See, measure and publish topics on the bus; works with any ROS 2 machine that speaks rmw_zenoh.",
    list=topic.list_topics,
    info=topic.info,
    echo=topic.echo,
    hz=topic.hz,
    bw=topic.bw,
    delay=topic.delay,
    pub=topic_pub.pub,
)
_group("node", "Look at the nodes on the bus.", list=node.list_nodes, info=node.info)
_group("service", "List and call services on the bus.", list=service.list_services, call=service.call_service)


@app.callback(invoke_without_command=True)
def _root(version: bool = typer.Option(False, "--version", help="Print the version and stop.")) -> None:
    if version:
        typer.echo(companion.__version__)
        raise typer.Exit


def main() -> None:
    """Entry point: exit codes 0 done, 1 the flight failed, 2 wrong input, 3 not reachable."""
    debug = "--debug" in sys.argv
    arguments = [a for a in sys.argv[1:] if a != "--debug"]
    try:
        app(args=arguments, standalone_mode=True)
    except CompanionError as error:
        if debug:
            raise
        Console(stderr=True, soft_wrap=True).print(f"[red]error:[/] {_escaped(error)}", highlight=False)
        sys.exit(error.exit_code)


def _escaped(error: CompanionError) -> str:
    return str(error).replace("[", r"\[")
