"""Other commands of ours that a command starts beside itself, and ends."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

STOP_S = 10.0


@contextmanager
def beside(command: Sequence[str], *, out: Path, words: Path) -> Iterator[subprocess.Popen[bytes]]:
    """`companion <command>` as a child; it gets Ctrl-C at the end, and is killed if that does not help."""
    with (
        out.open("wb") as stdout,
        words.open("wb") as stderr,
        subprocess.Popen(
            [sys.executable, "-m", "companion", *command],
            stdin=subprocess.DEVNULL,
            stdout=stdout,
            stderr=stderr,
            start_new_session=True,  # a Ctrl-C in the terminal is for us: we end it when it is time
        ) as child,
    ):
        try:
            yield child
        finally:
            _end(child)


@contextmanager
def recorder(folder: Path, bus: str) -> Iterator[None]:
    """`companion record` of everything on the bus into `folder`."""
    command = ["record", "--out", str(folder / "flight.mcap"), "--bus", bus]
    with beside(command, out=Path(os.devnull), words=folder / "recorder.log"):
        yield


def _end(child: subprocess.Popen[bytes]) -> None:
    child.send_signal(signal.SIGINT)
    try:
        child.wait(STOP_S)
    except subprocess.TimeoutExpired:
        child.kill()
