"""Run nodes in simulated time: one queue ordered by (time, sequence).

The order of everything is fixed by the queue, so a run is a pure function of the nodes and
their seeds. Compute time is modelled: a node is busy for the configured delay of what it
handles, its outputs become visible only then, and what arrives meanwhile waits (or, for
`keep="latest"`, replaces what waits). Nothing flies on zero-latency perception.
"""

from __future__ import annotations

import heapq
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from time import thread_time
from typing import Any, Protocol

import numpy as np

from companion.core.messages import freeze
from companion.core.node import Node, Output, Topic


class Tap(Protocol):
    """Sees every message once, in order, and every delivery and tick."""

    def published(self, now_ns: int, source: str, topic: Topic[Any], message: Any) -> int:
        """Take note of a message; returns its number."""

    def fed(self, now_ns: int, node: str, event: str, number: int) -> None:
        """A node gets message `number`, or a tick (number -1)."""


@dataclass(slots=True)
class _Event:
    name: str  # topic or timer
    topic: Topic[Any] | None
    message: Any = None
    number: int = -1


@dataclass(slots=True, eq=False)
class _Seat:
    """A node with what waits for it."""

    node: Node
    delays_ns: Mapping[str, int]
    busy_until_ns: int = 0
    waiting: deque[_Event] = field(default_factory=deque)
    waking: bool = False
    cpu_s: float = 0.0
    taken_s: dict[str, list[float]] = field(default_factory=dict)  # per event that gave outputs
    dropped: int = 0


class Lockstep:
    """Runs nodes; `delays_ns` maps node name -> {topic or timer name -> modelled compute time}."""

    def __init__(self, nodes: Sequence[Node], *, delays_ns: Mapping[str, Mapping[str, int]], tap: Tap) -> None:
        self.now_ns = 0
        self._tap = tap
        self._sequence = 0
        self._queue: list[tuple[int, int, _Seat | None, Any]] = []
        self._seats = [_Seat(n, delays_ns.get(name(n), {})) for n in nodes]
        self._subscribers: dict[str, list[_Seat]] = {}
        for seat in self._seats:
            for topic in seat.node.handlers:
                self._subscribers.setdefault(topic, []).append(seat)
            for timer in seat.node.timers:
                self._at(0, seat, _Event(timer, None))

    @property
    def cpu_s(self) -> dict[str, float]:
        """CPU seconds of this thread per node."""
        return {name(seat.node): seat.cpu_s for seat in self._seats}

    def compute_ms(self, percent: float) -> dict[str, dict[str, float]]:
        """Percentile of the CPU time per node and event with a modelled delay, of those that gave outputs."""
        return {
            name(seat.node): {e: float(np.percentile(t, percent)) * 1e3 for e, t in seat.taken_s.items()}
            for seat in self._seats
            if seat.taken_s
        }

    @property
    def dropped(self) -> dict[str, int]:
        """Messages that a busy node never saw since newer ones replaced them."""
        return {name(seat.node): seat.dropped for seat in self._seats}

    def publish(self, output: Output, *, source: str = "runtime") -> None:
        """Put a message from outside on its topic, now."""
        self._deliver(source, output)

    def run_until(self, end_ns: int) -> None:
        """Handle everything that is due up to and including `end_ns`."""
        while self._queue and self._queue[0][0] <= end_ns:
            self.now_ns, _, seat, what = heapq.heappop(self._queue)
            if seat is None:
                self._deliver(*what)
            elif what is None:
                self._wake(seat)
            else:
                self._arrive(seat, what)
        self.now_ns = end_ns

    def _arrive(self, seat: _Seat, event: _Event) -> None:
        if event.topic is None:  # a timer keeps its pace whatever the node does
            self._at(self.now_ns + seat.node.timers[event.name], seat, event)
        if seat.busy_until_ns <= self.now_ns and not seat.waiting:
            self._feed(seat, event)
            return
        if event.topic is None or event.topic.keep == "latest":
            kept = [e for e in seat.waiting if e.name != event.name]
            seat.dropped += len(seat.waiting) - len(kept)
            seat.waiting = deque(kept)
        seat.waiting.append(event)
        if not seat.waking:
            seat.waking = True
            self._at(seat.busy_until_ns, seat, None)

    def _wake(self, seat: _Seat) -> None:
        seat.waking = False
        while seat.waiting and seat.busy_until_ns <= self.now_ns:
            self._feed(seat, seat.waiting.popleft())
        if seat.waiting:
            seat.waking = True
            self._at(seat.busy_until_ns, seat, None)

    def _feed(self, seat: _Seat, event: _Event) -> None:
        source = name(seat.node)
        self._tap.fed(self.now_ns, source, event.name, event.number)
        started = thread_time()
        if event.topic is None:
            outputs = list(seat.node.tick(event.name, self.now_ns))
        else:
            outputs = list(seat.node.handle(event.topic, event.message))
        taken_s = thread_time() - started
        seat.cpu_s += taken_s
        if outputs and event.name in seat.delays_ns:
            seat.taken_s.setdefault(event.name, []).append(taken_s)
        delay_ns = seat.delays_ns.get(event.name, 0) if outputs else 0
        seat.busy_until_ns = self.now_ns + delay_ns
        for output in outputs:
            if delay_ns + output.delay_ns:
                self._at(self.now_ns + delay_ns + output.delay_ns, None, (source, output))
            else:
                self._deliver(source, output)

    def _deliver(self, source: str, output: Output) -> None:
        message = output.message
        if hasattr(message, "result"):
            message = message.result()
        freeze(message)
        number = self._tap.published(self.now_ns, source, output.topic, message)
        for seat in self._subscribers.get(output.topic.name, ()):
            self._at(self.now_ns, seat, _Event(output.topic.name, output.topic, message, number))

    def _at(self, time_ns: int, seat: _Seat | None, what: Any) -> None:
        self._sequence += 1
        heapq.heappush(self._queue, (time_ns, self._sequence, seat, what))


def name(node: Node) -> str:
    """A node is called by its class."""
    return type(node).__name__
