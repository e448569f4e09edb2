"""Ctrl-C and SIGTERM, taken by a command that ends in order."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType


@contextmanager
def on_interrupt(asked: Callable[[], None]) -> Iterator[None]:
    """Call `asked` at each SIGINT and SIGTERM, in the main thread; what it raises is raised there."""

    def take(_signal: int, _frame: FrameType | None) -> None:
        asked()

    before = {s: signal.signal(s, take) for s in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
