"""Run nodes in simulated time: one queue ordered by (time, sequence).

The order of everything is fixed by the queue, so a run is a pure function of the nodes and
their seeds. Compute time is modelled: a node is busy for the configured delay of what it
handles, its outputs become visible only then, and what arrives meanwhile waits (or, for
`keep="latest"`, replaces what waits). Nothing flies on zero-latency perception.

The same delay is what a second core can use: what a node computes is not needed before its
outputs become visible, so with an executor it is computed meanwhile, and waited for then, or
when its next message must know whether it is busy. Order and bytes are those of one thread.
"""

from __future__ import annotations

import heapq
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field
from functools import partial
from time import thread_time
from typing import Any, Protocol

import numpy as np

from companion.core.messages import freeze
from companion.core.node import Done, Node, Output, Pending, Topic


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
    """What a node does with one event, maybe still being computed."""

    event: _Event
    fed_ns: int
    outcome: Pending[tuple[list[Output], float]]  # outputs, CPU seconds


@dataclass(slots=True, eq=False)
class _Seat:
    """A node with what waits for it."""

    node: Node
    delays_ns: Mapping[str, int]
    busy_until_ns: int = 0
    waiting: deque[_Event] = field(default_factory=deque)
    waking: bool = False
    job: _Job | None = None  # the newest, if its result was not looked at
    cpu_s: float = 0.0
    taken_s: dict[str, list[float]] = field(default_factory=dict)  # per event that gave outputs
    dropped: int = 0


class Lockstep:
    """Runs nodes; `delays_ns` maps node name -> {topic or timer name -> modelled compute time}.

    `executor`: where events with a delay are computed; None: in the calling thread.
    """

    def __init__(
        self,
        nodes: Sequence[Node],
        *,
        delays_ns: Mapping[str, Mapping[str, int]],
        tap: Tap,
        executor: Executor | None = None,
    ) -> None:
        self.now_ns = 0
        self._tap, self._executor = tap, executor
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
            self.now_ns, _, act = heapq.heappop(self._queue)
            act()
        self.now_ns = end_ns

    def settle(self) -> None:
        """Wait for what is still being computed: then the nodes may be looked at."""
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
        delay_ns = seat.delays_ns.get(event.name, 0)
        if delay_ns and self._executor is not None:
            outcome: Any = self._executor.submit(_computed, seat.node, event, self.now_ns)
        else:
            outcome = Done(_computed(seat.node, event, self.now_ns))
        seat.job = job = _Job(event, self.now_ns, outcome)
        if delay_ns:
            self._at(self.now_ns + delay_ns, partial(self._publish, seat, job))
        else:
            self._settle(seat)
            self._publish(seat, job)

    def _settle(self, seat: _Seat) -> None:
        """Know how the newest job came out: one without outputs took no time."""
        if seat.job is None:
            return
        event, fed_ns = seat.job.event, seat.job.fed_ns
        outputs, taken_s = seat.job.outcome.result()
        seat.job = None
        seat.cpu_s += taken_s
        seat.busy_until_ns = fed_ns
        if outputs and event.name in seat.delays_ns:
            seat.taken_s.setdefault(event.name, []).append(taken_s)
            seat.busy_until_ns += seat.delays_ns[event.name]

    def _publish(self, seat: _Seat, job: _Job) -> None:
        if seat.job is job:
            self._settle(seat)
        for output in job.outcome.result()[0]:
            if output.delay_ns:
                self._at(self.now_ns + output.delay_ns, partial(self._deliver, name(seat.node), output))
            else:
                self._deliver(name(seat.node), output)

    def _deliver(self, source: str, output: Output) -> None:
        message = output.message
        if hasattr(message, "result"):
            message = message.result()
        freeze(message)
        number = self._tap.published(self.now_ns, source, output.topic, message)
        for seat in self._subscribers.get(output.topic.name, ()):
            event = _Event(output.topic.name, output.topic, message, number)
            self._at(self.now_ns, partial(self._arrive, seat, event))

    def _at(self, time_ns: int, act: Callable[[], None]) -> None:
        self._sequence += 1
        heapq.heappush(self._queue, (time_ns, self._sequence, act))


def _computed(node: Node, event: _Event, now_ns: int) -> tuple[list[Output], float]:
    """What a node makes of an event, and the CPU seconds of this thread that it took."""
    started = thread_time()
    if event.topic is None:
        outputs = list(node.tick(event.name, now_ns))
    else:
        outputs = list(node.handle(event.topic, event.message))
    return outputs, thread_time() - started


def name(node: Node) -> str:
    """A node is called by its class."""
    return type(node).__name__
