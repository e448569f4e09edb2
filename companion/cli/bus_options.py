"""What the tools on the bus share: options, Ctrl-C, lines that come one by one."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from threading import Event
from typing import Annotated

import typer
from rich.console import Console

from companion.cli.signals import on_interrupt
from companion.core.errors import CompanionError
from companion.runtime.bus.session import ENDPOINT

Bus = Annotated[str, typer.Option("--bus", help="Zenoh endpoint of the bus; of a ground link: tls/HOST:7448.")]
Certs = Annotated[
    Path | None, typer.Option("--certs", help="Certificates for a ground link: DIR, or DIR/NAME; see `companion keys`.")
]
Vehicle = Annotated[str, typer.Option("--name", help="Vehicle whose topics need no /NAME/ before them.")]
Json = Annotated[bool, typer.Option("--json", help="Print JSON, one object per line.")]
ForS = Annotated[float, typer.Option("--for-s", min=0, help="End after so many seconds (0: at Ctrl-C).")]
Count = Annotated[int, typer.Option("-n", "--count", min=0, help="End after so many messages (0: at Ctrl-C).")]

BUS, VEHICLE = ENDPOINT, "drone1"
_CONTROLS = {code: "\N{REPLACEMENT CHARACTER}" for code in (*range(32), *range(127, 160)) if chr(code) not in "\n\t"}


@contextmanager
def stopping() -> Iterator[Event]:
    """An event that Ctrl-C and SIGTERM set; a second one ends at once."""
    stopped = Event()

    def ask() -> None:
        if stopped.is_set():
            raise KeyboardInterrupt
        stopped.set()

    with on_interrupt(ask):
        yield stopped


def say(line: str) -> None:
    """One line on standard output, at once: a pipe must not hold it back.

    Strangers' names and words reach no terminal with control characters in them.
    """
    print(line.translate(_CONTROLS), flush=True)


def warn(line: str) -> None:
    """One line on standard error."""
    Console(stderr=True, soft_wrap=True).print(line, highlight=False, markup=False)


def nothing_heard(name: str, stopped: Event) -> CompanionError | None:
    """What to say if no message came; nothing if the user did not want to wait."""
    if stopped.is_set():
        return None
    return CompanionError(f"no message on {name} in the time: `companion topic info {name}` shows who publishes it")
