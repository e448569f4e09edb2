"""Run nodes in simulated time: one queue ordered by (time, sequence).

The order of everything is fixed by the queue, so a run is a pure function of the nodes and
their seeds. Compute time is modelled: a node is busy for the configured delay of what it
handles, its outputs become visible only then, and what arrives meanwhile waits (or, for
`keep="latest"`, replaces what waits). Nothing flies on zero-latency perception.

The same delay is what a second core can use: what a node computes is not needed before its
outputs become visible, so it is put off until then, or until its next message must know whether
it is busy, or until there is time because a sensor is still rendered elsewhere. Order and bytes
do not depend on when it is computed.
"""

from __future__ import annotations

import heapq
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from time import perf_counter, thread_time
from typing import Any, Protocol

import numpy as np

from companion.core.messages import freeze
from companion.core.node import Node, Output, Pending, Topic


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
class _Job:
    """What a node makes of one event, computed when it is first asked for."""

    event: _Event
    fed_ns: int
    outputs: list[Output] | None = None


@dataclass(slots=True, eq=False)
class _Seat:
    """A node with what waits for it."""

    node: Node
    delays_ns: Mapping[str, int]
    busy_until_ns: int = 0
    waiting: deque[_Event] = field(default_factory=deque)
    waking: bool = False
    job: _Job | None = None  # the newest, if it was not looked at
    cpu_s: float = 0.0
    taken_s: dict[str, list[float]] = field(default_factory=dict)  # per event that gave outputs
    dropped: int = 0


class Lockstep:
    """Runs nodes; `delays_ns` maps node name -> {topic or timer name -> modelled compute time}."""

    def __init__(self, nodes: Sequence[Node], *, delays_ns: Mapping[str, Mapping[str, int]], tap: Tap) -> None:
        self.now_ns = 0
        self._tap = tap
        self._sequence = 0
        self._queue: list[tuple[int, int, Callable[[], None]]] = []
        self._seats = [_Seat(n, delays_ns.get(name(n), {})) for n in nodes]
        self._subscribers: dict[str, list[_Seat]] = {}
        for seat in self._seats:
            for topic in seat.node.handlers:
                self._subscribers.setdefault(topic, []).append(seat)
            for timer in seat.node.timers:
                self._at(0, partial(self._arrive, seat, _Event(timer, None)))

    @property
    def cpu_s(self) -> dict[str, float]:
        """CPU seconds per node; what has no modelled delay is short, and counted by the wall clock."""
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
            self.now_ns, _, act = heapq.heappop(self._queue)
            act()
        self.now_ns = end_ns

    def settle(self) -> None:
        """Compute what was put off: then the nodes may be looked at."""
        for seat in self._seats:
            self._settle(seat)

    def _arrive(self, seat: _Seat, event: _Event) -> None:
        if event.topic is None:  # a timer keeps its pace whatever the node does
            self._at(self.now_ns + seat.node.timers[event.name], partial(self._arrive, seat, event))
        if not seat.waiting and self._is_free(seat):
            self._feed(seat, event)
            return
        if event.topic is None or event.topic.keep == "latest":
            kept = [e for e in seat.waiting if e.name != event.name]
            seat.dropped += len(seat.waiting) - len(kept)
            seat.waiting = deque(kept)
        seat.waiting.append(event)
        self._wake_when_free(seat)

    def _wake(self, seat: _Seat) -> None:
        seat.waking = False
        while seat.waiting and self._is_free(seat):
            self._feed(seat, seat.waiting.popleft())
        if seat.waiting:
            self._wake_when_free(seat)

    def _wake_when_free(self, seat: _Seat) -> None:
        if not seat.waking:
            seat.waking = True
            self._at(seat.busy_until_ns, partial(self._wake, seat))

    def _is_free(self, seat: _Seat) -> bool:
        self._settle(seat)
        return seat.busy_until_ns <= self.now_ns

    def _feed(self, seat: _Seat, event: _Event) -> None:
        self._tap.fed(self.now_ns, name(seat.node), event.name, event.number)
        seat.job = job = _Job(event, self.now_ns)
        if delay_ns := seat.delays_ns.get(event.name, 0):
            self._at(self.now_ns + delay_ns, partial(self._publish, seat, job))
        else:
            self._publish(seat, job)

    def _settle(self, seat: _Seat) -> None:
        """Compute the newest job if that was put off; one without outputs takes no simulated time."""
        job, seat.job = seat.job, None
        if job is None:
            return
        event = job.event
        clock = thread_time if event.name in seat.delays_ns else perf_counter  # asking for CPU time costs 0.6 us
        started = clock()
        if event.topic is None:
            job.outputs = list(seat.node.tick(event.name, job.fed_ns))
        else:
            job.outputs = list(seat.node.handle(event.topic, event.message))
        taken_s = clock() - started
        seat.cpu_s += taken_s
        seat.busy_until_ns = job.fed_ns
        if job.outputs and event.name in seat.delays_ns:
            seat.taken_s.setdefault(event.name, []).append(taken_s)
            seat.busy_until_ns += seat.delays_ns[event.name]

    def _publish(self, seat: _Seat, job: _Job) -> None:
        if seat.job is job:
            self._settle(seat)
        for output in job.outputs or ():
            if output.delay_ns:
                self._at(self.now_ns + output.delay_ns, partial(self._deliver, name(seat.node), output))
            else:
                self._deliver(name(seat.node), output)

    def _deliver(self, source: str, output: Output) -> None:
        message = output.message
        if hasattr(message, "result"):
            self._use_the_wait(message)
            message = message.result()
        freeze(message)
        number = self._tap.published(self.now_ns, source, output.topic, message)
        for seat in self._subscribers.get(output.topic.name, ()):
            event = _Event(output.topic.name, output.topic, message, number)
            self._at(self.now_ns, partial(self._arrive, seat, event))

    def _use_the_wait(self, message: Pending[Any]) -> None:
        """Compute what was put off, oldest first, while a message is not ready."""
        for seat in sorted((s for s in self._seats if s.job), key=_fed_ns):
            if message.ready():
                return
            self._settle(seat)

    def _at(self, time_ns: int, act: Callable[[], None]) -> None:
        self._sequence += 1
        heapq.heappush(self._queue, (time_ns, self._sequence, act))


def _fed_ns(seat: _Seat) -> int:
    return seat.job.fed_ns if seat.job else 0


def name(node: Node) -> str:
    """A node is called by its class."""
    return type(node).__name__
