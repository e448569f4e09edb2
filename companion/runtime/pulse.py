"""How often each topic passes, and how long it was silent: what a deadline is compared with."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

from companion.core.node import Topic


@dataclass(slots=True)
class _Beat:
    newest_ns: int
    count: int = 0
    worst_ns: int = 0  # silence, since the last report


class Pulse:
    """Counts messages per topic; as an outlet it sends nothing.

    A silence counts from the topic's last message, or for `expected` topics from the start.
    """

    def __init__(self, expected: Iterable[Topic[Any]] = (), *, clock: Callable[[], int] = time.monotonic_ns) -> None:
        self._clock = clock
        now_ns = clock()
        self._beats = {topic.name: _Beat(now_ns) for topic in expected}

    def publish(self, topic: Topic[Any], message: Any, now_ns: int) -> None:
        """One message has passed."""
        now_ns = self._clock()
        beat = self._beats.get(topic.name)
        if beat is None:
            beat = self._beats[topic.name] = _Beat(now_ns)
        beat.worst_ns = max(beat.worst_ns, now_ns - beat.newest_ns)
        beat.newest_ns = now_ns
        beat.count += 1

    def figures(self, what: str) -> dict[str, float]:
        """`<what> <topic>`: messages so far; `<what> silence <topic>`: the longest silence since the last call, s."""
        now_ns, figures = self._clock(), {}
        for name, beat in list(self._beats.items()):
            figures[f"{what} {name}"] = float(beat.count)
            figures[f"{what} silence {name}"] = max(beat.worst_ns, now_ns - beat.newest_ns) * 1e-9
            beat.worst_ns = 0
        return figures
