"""Run a group of nodes in real time: one thread and one mailbox per node.

Messages between nodes of the group pass as objects; what is published goes to the outlets, too
(the bus, the link to the vehicle). Order is kept per node, which is what a replay needs.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from threading import Event, Thread
from typing import Any, Protocol

from companion.core.errors import CompanionError
from companion.core.messages import freeze
from companion.core.node import Node, Output, Topic
from companion.runtime.clock import Clock
from companion.runtime.lockstep import name
from companion.runtime.mailbox import Mailbox, Parcel

IDLE_S = 0.5  # a node without timers looks up this often


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
    """One node with its thread."""

    def __init__(self, node: Node, group: LiveGroup) -> None:
        self.node, self.name = node, name(node)
        self.mailbox = Mailbox()
        self.statistics = NodeStatistics()
        self._group = group
        self._stop = Event()
        self._thread = Thread(target=self._run, name=self.name, daemon=True)

    def start(self) -> None:
        """Begin to tick and to handle."""
        self._thread.start()

    def stop(self, timeout_s: float) -> bool:
        """End after the event in hand; False if the node is still busy then."""
        self._stop.set()
        self.mailbox.wake()
        if self._thread.ident is not None:
            self._thread.join(timeout_s)
        return not self._thread.is_alive()

    def _run(self) -> None:
        try:
            self._loop()
        except BaseException as error:
            self._group.fail(self.name, error)

    def _loop(self) -> None:
        clock, timers = self._group.clock, self.node.timers
        due_ns = dict.fromkeys(timers, clock.now_ns())
        while not self._stop.is_set():
            wait_s = min((d - clock.now_ns() for d in due_ns.values()), default=int(IDLE_S * 1e9)) * 1e-9
            parcel = self.mailbox.take(wait_s)
            if parcel is not None:
                self._open(parcel)
            now_ns = clock.now_ns()
            for timer, when_ns in due_ns.items():
                if when_ns <= now_ns:
                    due_ns[timer] = when_ns + self._tick(timer, now_ns, when_ns)

    def _tick(self, timer: str, now_ns: int, due_ns: int) -> int:
        """Run a timer; returns how far its next due time is, whole periods."""
        period_ns, late_ns = self.node.timers[timer], now_ns - due_ns
        missed = late_ns // period_ns
        self.statistics.ticks += 1
        self.statistics.late_ticks += missed
        self.statistics.worst_late_ns = max(self.statistics.worst_late_ns, late_ns)
        self._do(now_ns, timer, -1, lambda: list(self.node.tick(timer, now_ns)))
        return period_ns * (missed + 1)

    def _open(self, parcel: Parcel) -> None:
        now_ns = self._group.clock.now_ns()
        try:
            message, number = parcel.open(lambda t, m: self._group.log.received(now_ns, t, m))
        except CompanionError:  # a stranger's payload
            self.statistics.refused += 1
            return
        self.statistics.handled += 1
        self._do(now_ns, parcel.topic.name, number, lambda: list(self.node.handle(parcel.topic, message)))

    def _do(self, now_ns: int, event: str, number: int, act: Callable[[], list[Output]]) -> None:
        self._group.log.fed(now_ns, self.name, event, number)
        self.statistics.busy_since_ns, started_s = now_ns, time.thread_time()
        for output in act():
            self._group.publish(self.name, output)
        self.statistics.cpu_s += time.thread_time() - started_s
        self.statistics.busy_since_ns = 0


class LiveGroup:
    """Nodes of one process; `receive` brings what comes from outside."""

    def __init__(self, nodes: Sequence[Node], *, clock: Clock, log: InboxLog, outlets: Sequence[Outlet]) -> None:
        self.clock, self.log = clock, log
        self.failure: tuple[str, BaseException] | None = None
        self.failed = Event()
        self.seats = [LiveNode(node, self) for node in nodes]
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
        for seat in self.seats:
            seat.start()

    def stop(self, timeout_s: float = 2.0) -> list[str]:
        """End every node, the first in the data flow first; names of those that still hang."""
        return [seat.name for seat in self.seats if not seat.stop(timeout_s)]

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
