"""The `companion` command: mounts the command groups and turns user errors into one line.

Only what was asked for is imported: `companion topic list` must not wait for a simulator to load.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from importlib import import_module
from typing import Any

import typer
from rich.console import Console

import companion
from companion.core.errors import CompanionError

COMMANDS = {  # command -> module and function in companion.cli
    "fly": "fly:fly",
    "run": "run:run",
    "sim": "sim:sim",
    "record": "record:record",
    "replay": "replay:replay",
    "export": "export:export",
    "top": "top:top",
    "doctor": "doctor:doctor",
    "odometry": "odometry:odometry",
}
GROUPS = {  # group -> help, command -> module and function
    "mission": (
        "Check mission files; store them in an autopilot.",
        {
            "check": "mission:check",
            "table": "mission:table",
            "upload": "mission:upload",
            "download": "mission:download",
        },
    ),
    "config": ("Show the configuration.", {"dump": "config:dump"}),
    "keys": (
        "Make and check keys: of MAVLink signing, and of the ground link.",
        {"new": "keys:new", "ca": "keys:ca", "cert": "keys:cert", "show": "keys:show"},
    ),
    "param": (
        "See and set the autopilot's parameters; needs MAVSDK.",
        {
            "get": "param:get",
            "set": "param:set_",
            "list": "param:list_parameters",
            "save": "param:save",
            "load": "param:load",
        },
    ),
    "mavlink": ("Look into MAVLink logs.", {"inspect": "mavlink:inspect"}),
    "graph": ("Optimise pose graphs.", {"optimise": "graph:optimise_file"}),
    "map": (
        "Look into maps, convert, slice and draw them; find ways through them.",
        {
            "info": "map:info",
            "convert": "map:convert",
            "slice": "map:slice_",
            "view": "map:view",
            "locate": "map_locate:locate_flight",
            "roadmap": "map_route:roadmap",
            "route": "map_route:route",
        },
    ),
    "bench": (
        "Measure this machine.",
        {
            "bus": "bench:bus",
            "estimators": "bench_estimators:estimators",
            "mapping": "bench_mapping:mapping",
            "places": "bench_places:places",
            "estimation": "bench_estimation:estimation",
            "planners": "bench_planners:planners",
            "planning": "bench_planning:planning",
            "tracking": "bench_tracking:tracking",
        },
    ),
    "tune": ("Find settings by flying with them in the simulator.", {"lookahead": "tune:lookahead"}),
    "topic": (
        "See, measure and publish topics on the bus; works with any ROS 2 machine that speaks rmw_zenoh.",
        {
            "list": "topic:list_topics",
            "info": "topic:info",
            "echo": "topic:echo",
            "hz": "topic:hz",
            "bw": "topic:bw",
            "delay": "topic:delay",
            "pub": "topic_pub:pub",
            "package": "ros:package",
        },
    ),
    "node": ("Look at the nodes on the bus.", {"list": "node:list_nodes", "info": "node:info"}),
    "service": (
        "List and call services on the bus.",
        {"list": "service:list_services", "call": "service:call_service"},
    ),
}


def build(words: Sequence[str] = ()) -> typer.Typer:
    """The command line; if `words` begin with a command or group, with that one alone."""
    asked = words[0] if words else ""
    whole = asked not in COMMANDS and asked not in GROUPS
    app = typer.Typer(
        name="companion",
        help="Fly, check and inspect Understory missions. Example: companion fly missions/first_flight.yaml",
        no_args_is_help=True,
        pretty_exceptions_enable=False,
    )
    app.callback(invoke_without_command=True)(_root)
    for name, place in COMMANDS.items():
        if whole or name == asked:
            app.command(name)(_function(place))
    for name, (text, commands) in GROUPS.items():
        if whole or name == asked:
            group = typer.Typer(help=text, no_args_is_help=True)
            for command, place in commands.items():
                group.command(command)(_function(place))
            app.add_typer(group, name=name)
    return app


def __getattr__(name: str) -> Any:
    """`app`, the whole command line, made when somebody wants it."""
    if name == "app":
        return build()
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def main() -> None:
    """Entry point: exit codes 0 done, 1 the flight failed, 2 wrong input, 3 not reachable."""
    debug = "--debug" in sys.argv
    arguments = [a for a in sys.argv[1:] if a != "--debug"]
    try:
        build(arguments)(args=arguments, standalone_mode=True)
    except CompanionError as error:
        if debug:
            raise
        Console(stderr=True, soft_wrap=True).print(f"[red]error:[/] {_escaped(error)}", highlight=False)
        sys.exit(error.exit_code)


def _root(version: bool = typer.Option(False, "--version", help="Print the version and stop.")) -> None:
    if version:
        typer.echo(companion.__version__)
        raise typer.Exit


def _function(place: str) -> Callable[..., Any]:
    module, _, function = place.partition(":")
    found: Callable[..., Any] = getattr(import_module(f"companion.cli.{module}"), function)
    return found


def _escaped(error: CompanionError) -> str:
    return str(error).replace("[", r"\[")
