"""`companion top`: how a live stack fares, as htop shows a computer."""

from __future__ import annotations

import os
import select
import sys
import termios
import time
import tty
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from threading import Event
from typing import Annotated

import typer
from rich.console import Console, Group
from rich.live import Live
from rich.table import Table
from rich.text import Text

from companion.cli.bus_options import BUS, Bus, Certs, ForS, Json, say, stopping
from companion.runtime.tools.desk import Desk
from companion.runtime.tools.show import as_json
from companion.runtime.tools.top import OLD_S, Picture, Status, Top

COLOURS = {"ok": "green", "warn": "yellow", "error": "red", "stale": "magenta"}
FIRST_S = 2.5  # in which a report must come, if there is a stack
LOOK_AROUND_S = 5.0
KEY_S = 0.1
WIDTH = 100  # of what is printed into a file


def top(
    once: Annotated[bool, typer.Option("--once", help="Print it once, then end.")] = False,
    for_s: ForS = 0.0,
    bus: Bus = BUS,
    certs: Certs = None,
    as_json_: Json = False,
) -> None:
    """Watch nodes, CPU, rates, deadlines, restarts and drops of a live stack. Example: companion top

    q or Ctrl-C ends it. The figures are those of `/diagnostics`, which `companion run` publishes once per second.
    Exit code 3: no bus is there.
    """
    with Desk(bus, certs=certs) as desk, stopping() as stopped:
        seen = Top(desk)
        _settle(seen, stopped)
        if once:
            _print(seen.picture(time.monotonic_ns()), as_json_=as_json_)
        elif as_json_ or not sys.stdout.isatty():
            for picture in _pictures(seen, stopped.is_set, for_s):
                _print(picture, as_json_=as_json_)
        else:
            _watch(seen, stopped, for_s)


def _settle(seen: Top, stopped: Event) -> None:
    """Two reports, if any come: rates need a second one."""
    until_s, reports = time.monotonic() + FIRST_S, 0
    while reports < 2 and time.monotonic() < until_s and not stopped.is_set():
        reports += seen.wait(KEY_S)
    seen.look_around()


def _pictures(seen: Top, over: Callable[[], bool], for_s: float) -> Iterator[Picture]:
    """One per report, or one per second while there are none; `over` is asked ten times a second."""
    begin_s = time.monotonic()
    shown_s = around_s = begin_s
    yield seen.picture(time.monotonic_ns())
    while not over() and not 0 < for_s <= time.monotonic() - begin_s:
        fresh, now_s = seen.wait(KEY_S), time.monotonic()
        if now_s - around_s > LOOK_AROUND_S:
            seen.look_around()
            around_s = now_s
        if fresh or now_s - shown_s >= 1.2:
            shown_s = now_s
            yield seen.picture(time.monotonic_ns())


def _watch(seen: Top, stopped: Event, for_s: float) -> None:
    with _keys() as pressed, Live(screen=True, auto_refresh=False) as live:
        for picture in _pictures(seen, lambda: stopped.is_set() or pressed("q"), for_s):
            live.update(_drawn(picture), refresh=True)


@contextmanager
def _keys() -> Iterator[Callable[[str], bool]]:
    """Whether a key was pressed since the last question; never, if nobody types."""
    if not sys.stdin.isatty():
        yield lambda key: False
        return
    descriptor = sys.stdin.fileno()
    before = termios.tcgetattr(descriptor)

    def pressed(key: str) -> bool:
        return bool(select.select([descriptor], [], [], 0)[0]) and key.encode() in os.read(descriptor, 64)

    try:
        tty.setcbreak(descriptor)
        yield pressed
    finally:
        termios.tcsetattr(descriptor, termios.TCSADRAIN, before)


def _print(picture: Picture, *, as_json_: bool) -> None:
    if as_json_:
        say(as_json(picture.plain))
    else:
        console = Console()
        console.width = max(console.width, WIDTH)
        console.print(_drawn(picture))


def _drawn(picture: Picture) -> Group:
    parts: list[Table | Text] = []
    if not picture.statuses:
        parts.append(Text("no companion run reports on this bus; it would, once per second, in /diagnostics"))
    elif picture.age_s > OLD_S:
        parts.append(Text(f"the last report came {picture.age_s:.0f} s ago: the stack has ended", style="red"))
    if groups := picture.of("group"):
        parts += [_groups(groups), Text()]
    if nodes := picture.of("node"):
        parts += [_nodes(nodes), Text()]
    if topics := picture.of("topic"):
        parts += [_topics(topics), Text()]
    if picture.others:
        parts.append(Text(f"beside them on the bus: {', '.join(picture.others)}", style="dim"))
    return Group(*parts)


def _groups(groups: list[Status]) -> Table:
    table = _table("process", "pid", "CPU %", "memory MB", "restarts", "heard", "lost", "state")
    for s in groups:
        figures = ("pid", "cpu_percent", "memory_mb", "restarts", "bus_heard", "bus_lost")
        table.add_row(s.name, *(_text(s, key, 0 if key != "cpu_percent" else 1) for key in figures), _state(s))
    return table


def _nodes(nodes: list[Status]) -> Table:
    table = _table("node", "CPU %", "in Hz", "waiting", "dropped", "refused", "late", "worst ms", "state")
    for s in nodes:
        short = s.name.rsplit("/", 1)[-1]
        figures = (("cpu_percent", 1), ("handled_hz", 0), ("waiting", 0), ("dropped", 0), ("refused", 0))
        ticks = (("late_ticks", 0), ("worst_late_ms", 1))
        table.add_row(short, *(_text(s, key, digits) for key, digits in (*figures, *ticks)), _state(s))
    return table


def _topics(topics: list[Status]) -> Table:
    table = _table("topic", "Hz", "due Hz", "count", "silent s", "limit s", "state")
    for s in topics:
        figures = (("rate_hz", 1), ("expected_hz", 0), ("count", 0), ("silence_s", 2), ("deadline_s", 2))
        table.add_row(s.name, *(_text(s, key, digits) for key, digits in figures), _state(s))
    return table


def _table(*columns: str) -> Table:
    table = Table(*columns, box=None, pad_edge=False, header_style="bold")
    for column in table.columns[1:-1]:
        column.justify = "right"
    return table


def _text(status: Status, key: str, digits: int) -> str:
    value = status.figure(key)
    return "-" if value != value else f"{value:.{digits}f}"


def _state(status: Status) -> Text:
    return Text(status.message, style=COLOURS[status.level])
