"""Run a group of nodes in real time: one mailbox per node, one thread per crew of nodes.

Messages between nodes of the group pass as objects; what is published goes to the outlets, too
(the bus, the link to the vehicle). Order is kept per node, which is what a replay needs. Nodes
that take long have a thread of their own; light ones share one, since handing over costs more.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from threading import Event, Thread
from typing import Any, Protocol

from companion.core.errors import CompanionError
from companion.core.messages import freeze
from companion.core.node import Node, Output, Topic
from companion.runtime.clock import Clock
from companion.runtime.lockstep import name
from companion.runtime.mailbox import Bell, Mailbox, Parcel

IDLE_S = 0.5  # a thread without timers looks up this often
NEVER_NS = 2**62


class InboxLog(Protocol):
    """Notes what goes into each node and what comes out, in order; called from every node's thread."""

    def received(self, now_ns: int, topic: Topic[Any], message: Any) -> int:
        """Take note of a message from outside the process; returns its number."""

    def published(self, now_ns: int, source: str, topic: Topic[Any], message: Any) -> int:
        """Take note of a message of a node of this process; returns its number."""

    def fed(self, now_ns: int, node: str, event: str, number: int) -> None:
        """A node gets message `number`, or a tick (number -1)."""


class Outlet(Protocol):
    """Where messages leave the process."""

    def publish(self, topic: Topic[Any], message: Any, now_ns: int) -> None:
        """Send, or leave, one message; never waits."""


@dataclass(slots=True)
class NodeStatistics:
    """What a node has done so far."""

    handled: int = 0
    ticks: int = 0
    late_ticks: int = 0  # skipped since the node was busy for more than a period
    refused: int = 0  # messages that could not be decoded
    cpu_s: float = 0.0
    busy_since_ns: int = 0  # 0: idle
    worst_late_ns: int = 0  # of a tick


class LiveNode:
    """One node with its mailbox; driven by the thread of its crew alone."""

    def __init__(self, node: Node, group: LiveGroup, bell: Bell) -> None:
        self.node, self.name = node, name(node)
        self.mailbox = Mailbox(bell)
        self.statistics = NodeStatistics()
        self._group = group
        self._due_ns: dict[str, int] = {}

    def begin(self, now_ns: int) -> None:
        """All timers are due at once."""
        self._due_ns = dict.fromkeys(self.node.timers, now_ns)

    @property
    def due_ns(self) -> int:
        """When its next timer is due."""
        return min(self._due_ns.values(), default=NEVER_NS)

    def tick(self, now_ns: int) -> None:
        """Run what is due; whole periods that were missed are left out."""
        for timer, due_ns in self._due_ns.items():
            if due_ns <= now_ns:
                period_ns, late_ns = self.node.timers[timer], now_ns - due_ns
                missed = late_ns // period_ns
                self._due_ns[timer] = due_ns + period_ns * (missed + 1)
                self.statistics.ticks += 1
                self.statistics.late_ticks += missed
                self.statistics.worst_late_ns = max(self.statistics.worst_late_ns, late_ns)
                self._do(now_ns, timer, -1, partial(self.node.tick, timer, now_ns))

    def handle_next(self) -> bool:
        """Handle the oldest message; False if there is none."""
        parcel = self.mailbox.take()
        if parcel is None:
            return False
        now_ns = self._group.clock.now_ns()
        try:
            message, number = parcel.open(lambda t, m: self._group.log.received(now_ns, t, m))
        except CompanionError:  # a stranger's payload
            self.statistics.refused += 1
            return True
        self.statistics.handled += 1
        self._do(now_ns, parcel.topic.name, number, partial(self.node.handle, parcel.topic, message))
        return True

    def _do(self, now_ns: int, event: str, number: int, act: Callable[[], Iterator[Output]]) -> None:
        self._group.log.fed(now_ns, self.name, event, number)
        self.statistics.busy_since_ns, started_s = now_ns, time.thread_time()
        for output in list(act()):
            self._group.publish(self.name, output)
        self.statistics.cpu_s += time.thread_time() - started_s
        self.statistics.busy_since_ns = 0


class Crew:
    """Nodes that share a thread: timers first, then one message of each in turn."""

    def __init__(self, nodes: Sequence[Node], group: LiveGroup) -> None:
        self._bell = Bell()
        self.seats = [LiveNode(node, group, self._bell) for node in nodes]
        self._group = group
        self._stop = Event()
        self._thread = Thread(target=self._run, name="+".join(seat.name for seat in self.seats), daemon=True)

    def start(self) -> None:
        """Begin to tick and to handle."""
        self._thread.start()

    def stop(self, timeout_s: float) -> bool:
        """End after the event in hand; False if a node is still busy then."""
        self._stop.set()
        with self._bell.lock:
            self._bell.ring()
        if self._thread.ident is not None:
            self._thread.join(timeout_s)
        return not self._thread.is_alive()

    def _run(self) -> None:
        now_ns = self._group.clock.now_ns()
        for seat in self.seats:
            seat.begin(now_ns)
        seat = self.seats[0]
        try:
            while not self._stop.is_set():
                busy = False
                for seat in self.seats:
                    self._tick_all()
                    busy = seat.handle_next() or busy
                if not busy:
                    due_ns = min(seat.due_ns for seat in self.seats)
                    self._bell.wait(min(self._group.clock.wait_s(due_ns), IDLE_S))
        except BaseException as error:
            self._group.fail(seat.name, error)

    def _tick_all(self) -> None:
        now_ns = self._group.clock.now_ns()
        for seat in self.seats:
            if seat.due_ns <= now_ns:
                seat.tick(now_ns)


class LiveGroup:
    """Nodes of one process; `receive` brings what comes from outside. `shared`: all on one thread."""

    def __init__(
        self,
        nodes: Sequence[Node],
        *,
        clock: Clock,
        log: InboxLog,
        outlets: Sequence[Outlet],
        shared: bool = False,
    ) -> None:
        self.clock, self.log = clock, log
        self.failure: tuple[str, BaseException] | None = None
        self.failed = Event()
        self._crews = [Crew(nodes, self)] if shared else [Crew([node], self) for node in nodes]
        self.seats = [seat for crew in self._crews for seat in crew.seats]
        self._outlets = tuple(outlets)
        self._subscribers: dict[str, list[LiveNode]] = {}
        for seat in self.seats:
            for topic in seat.node.handlers:
                self._subscribers.setdefault(topic, []).append(seat)

    @property
    def published(self) -> list[Topic[Any]]:
        """Every topic that a node of the group publishes, once."""
        return list({t.name: t for seat in self.seats for t in seat.node.publishes}.values())

    @property
    def wanted(self) -> list[Topic[Any]]:
        """Every topic that must come from outside: subscribed, and not published here."""
        own = {t.name for t in self.published}
        wanted = {t.name: t for seat in self.seats for t in seat.node.subscribes if t.name not in own}
        return list(wanted.values())

    def start(self) -> None:
        """Let every node run."""
        for crew in self._crews:
            crew.start()

    def stop(self, timeout_s: float = 2.0) -> list[str]:
        """End every node, the first in the data flow first; names of those that still hang."""
        return [seat.name for crew in self._crews if not crew.stop(timeout_s) for seat in crew.seats]

    def receive(self, topic: Topic[Any], message: Any, *, decode: Callable[[Any], Any] | None = None) -> None:
        """A message from outside, on any thread; `decode` turns a payload into a message, later."""
        self._hand_out(Parcel(topic, message, decode=decode))

    def publish(self, source: str, output: Output) -> None:
        """A message of a node: to the log, to the nodes of this group, to the outlets."""
        now_ns, topic, message = self.clock.now_ns(), output.topic, freeze(output.message)
        number = self.log.published(now_ns, source, topic, message)
        for outlet in self._outlets:
            outlet.publish(topic, message, now_ns)
        self._hand_out(Parcel(topic, message, number=number))

    def fail(self, node: str, error: BaseException) -> None:
        """A node raised: its process cannot be trusted any more."""
        if self.failure is None:
            self.failure = (node, error)
        self.failed.set()

    def _hand_out(self, parcel: Parcel) -> None:
        for seat in self._subscribers.get(parcel.topic.name, ()):
            seat.mailbox.put(parcel)
