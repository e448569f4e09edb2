"""Feed the nodes of a logged process what they were fed, and compare what comes out, byte for byte.

    replay = Replay(path, rebuild(read_header(path)))
    for time_ns in replay.run():
        ...
    assert replay.identical

A message of another node of the process is computed again, by replaying that node; one from outside
must be in the log. Twins (`changed`) are nodes built otherwise, with other parameters: each gets the
same deliveries, and its outputs are compared with those of the original.
"""

from __future__ import annotations

from collections import Counter, defaultdict, deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from xxhash import xxh3_128_digest

from companion.core import topics
from companion.core.errors import InputError
from companion.core.messages import freeze
from companion.core.node import Node, Output
from companion.runtime.codec import decode, digest
from companion.runtime.lockstep import name
from companion.runtime.log_file import End, Fed, Header, LogDamaged, Message, entries
from companion.runtime.message_diff import TopicDifferences, differences
from companion.runtime.replay_plan import blocked_nodes, survey, with_producers
from companion.runtime.replay_report import Difference, NodeReport

RECORD_HINT = "a flight flown with --record"
UNFINISHED = 2  # a node's last deliveries whose outputs the end of the log may have cut off


class Listener(Protocol):
    """Hears every message of a replay, also what was computed again."""

    def heard(self, entry: Message, message: Any) -> None:
        """One message and its entry, in the order of the log; None where nobody knows it."""


@dataclass(slots=True, eq=False)
class _Pending:
    """An output that the log must show next."""

    output: Output
    delivery: int
    twin: Any  # the twin's counterpart, None if it has none


@dataclass(slots=True, eq=False)
class _Seat:
    node: Node
    twin: Node | None
    report: NodeReport
    pending: deque[_Pending] = field(default_factory=deque)


class Replay:
    """One log; `nodes` and `changed` are built from its header, `changed` with other parameters."""

    def __init__(
        self,
        path: Path,
        nodes: Sequence[Node],
        *,
        changed: Sequence[Node] = (),
        only: str = "",
        chain: bool = False,
        listener: Listener | None = None,
    ) -> None:
        self.path, self.only = path, only
        self.end_reason: str | None = None  # None: the log has no end, its process was killed
        self.end_ns = 0
        self._chain, self._listener = chain, listener
        deliveries, unstored = survey(path)
        self.blocked = blocked_nodes(nodes, unstored)  # node -> (topic that is not stored, its source)
        wanted = with_producers(only, nodes, unstored) if only else {name(n) for n in nodes} - self.blocked.keys()
        if only in self.blocked:
            topic, source = self.blocked[only]
            raise InputError(
                f"{only} needs {topic} of {source}, which this log does not store",
                field="--node",
                valid=f"{RECORD_HINT}, or one of {', '.join(n for n in map(name, nodes) if n not in self.blocked)}",
            )
        self._uses = Counter(number for node, number in deliveries if node in wanted)
        twins = {name(n): n for n in changed if not only or chain or name(n) == only}
        self._seats = {name(n): _Seat(n, twins.get(name(n)), NodeReport()) for n in nodes if name(n) in wanted}
        self._messages: dict[int, tuple[Any, Any]] = {}  # number -> (message, its twin); while someone needs it

    @property
    def reports(self) -> dict[str, NodeReport]:
        """Per node, in the order of the data flow."""
        return {n: s.report for n, s in self._seats.items() if not self.only or n == self.only}

    @property
    def first(self) -> Difference | None:
        """The first output that is not as logged."""
        found = [s.report.first for s in self._seats.values() if s.report.first]
        return min(found, key=lambda d: d.time_ns, default=None)

    @property
    def identical(self) -> bool:
        """Whether every output is the logged one to the byte."""
        return self.first is None

    def run(self) -> Iterator[int]:
        """Replay the log, once; yields the time of every entry."""
        number = -1
        for entry in entries(self.path):
            if isinstance(entry, Message):
                number += 1
                self._published(number, entry)
            elif isinstance(entry, Fed):
                self._feed(entry)
            elif isinstance(entry, End):
                self.end_reason = entry.reason
            if not isinstance(entry, Header):
                self.end_ns = max(self.end_ns, entry.time_ns)
                yield entry.time_ns
        for node, seat in self._seats.items():
            self._too_many(node, seat)

    def _feed(self, fed: Fed) -> None:
        seat = self._seats.get(fed.node)
        if seat is None:
            return
        message, twin = self._take(fed)
        seat.report.deliveries += 1
        outputs = _act(seat.node, fed, message)
        changed = _act(seat.twin, fed, twin if self._chain else message) if seat.twin else []
        pairs = _paired(outputs, changed) if seat.twin else [(o, None) for o in outputs]
        if seat.twin:
            self._compare_twin(fed, seat.report, pairs)
        for output, other in pairs:
            if output is not None:
                counterpart = other.message if other else None
                seat.pending.append(_Pending(output, seat.report.deliveries, counterpart))

    def _take(self, fed: Fed) -> tuple[Any, Any]:
        """The delivered message and its twin; forgotten after the last delivery."""
        if fed.number < 0:
            return None, None
        if fed.number not in self._messages:
            raise LogDamaged(f"{_moment(fed)}: message {fed.number} is not in the log before it")
        pair = self._messages[fed.number]
        self._uses[fed.number] -= 1
        if self._uses[fed.number] == 0:
            del self._messages[fed.number]
        return pair

    def _published(self, number: int, entry: Message) -> None:
        if entry.topic not in topics.BY_NAME:
            raise LogDamaged(f"{self.path.name}, message {number}: no topic is called {entry.topic!r}")
        if entry.payload is not None and xxh3_128_digest(entry.payload) != entry.digest:
            raise LogDamaged(f"{_place(entry)}: its bytes do not have the digest that was noted")
        seat = self._seats.get(entry.source)
        message, twin = self._computed(seat, entry) if seat else (None, None)
        if message is None and entry.payload is not None and (self._listener or self._uses[number]):
            message = _decoded(entry)
        if self._listener:
            self._listener.heard(entry, message)
        if message is None or not self._uses[number]:
            return
        self._messages[number] = (message, message if twin is None else twin)

    def _computed(self, seat: _Seat, entry: Message) -> tuple[Any, Any]:
        """The node's next output on the entry's topic, compared with the log; None if there is none."""
        seat.report.outputs += 1
        at = next((k for k, p in enumerate(seat.pending) if p.output.topic.name == entry.topic), None)
        if at is None:
            logged = _decoded(entry) if entry.payload is not None else None
            seat.report.differs(_difference(entry, logged, ("it is logged, the replay does not give it",)))
            return None, None
        for extra in [seat.pending[k] for k in range(at)]:
            seat.pending.remove(extra)
            seat.report.differs(_extra(entry.source, entry.time_ns, extra))
        pending = seat.pending.popleft()
        message = freeze(pending.output.message)
        if digest(message)[0] != entry.digest:
            what: tuple[str, ...] = ("its bytes differ, the log holds no more than their digest",)
            if entry.payload is not None:
                what = tuple(map(str, differences(_decoded(entry), message))) or ("the same fields in other bytes",)
            seat.report.differs(_difference(entry, message, what))
        return message, pending.twin

    def _compare_twin(self, fed: Fed, report: NodeReport, pairs: Sequence[tuple[Output | None, Output | None]]) -> None:
        for output, other in pairs:
            one = output or other
            assert one is not None
            table = report.changed.setdefault(one.topic.name, TopicDifferences())
            if output is None or other is None:
                table.only_logged += output is not None
                table.only_replayed += output is None
                what: tuple[str, ...] = ("only with the change" if output is None else "not with the change",)
            else:
                what = tuple(map(str, table.add(output.message, other.message)))
            if what and report.first_changed is None:
                stamp_ns = one.message.stamp_ns
                report.first_changed = Difference(fed.node, one.topic.name, fed.time_ns, stamp_ns, what)

    def _too_many(self, node: str, seat: _Seat) -> None:
        """Outputs that the log does not show, but of those that its end may have cut off."""
        for extra in seat.pending:
            if extra.delivery <= seat.report.deliveries - UNFINISHED:
                seat.report.differs(_extra(node, self.end_ns, extra))


def _act(node: Node, fed: Fed, message: Any) -> list[Output]:
    if fed.number < 0:
        if fed.event not in node.timers:
            raise LogDamaged(f"{_moment(fed)}: it has no timer {fed.event!r}")
        return list(node.tick(fed.event, fed.time_ns))
    if fed.event not in node.handlers:
        raise LogDamaged(f"{_moment(fed)}: it does not take {fed.event!r}")
    return list(node.handle(topics.BY_NAME[fed.event], message))


def _moment(fed: Fed) -> str:
    return f"{fed.node} at {fed.time_ns * 1e-9:.6f} s"


def _paired(outputs: Sequence[Output], changed: Sequence[Output]) -> list[tuple[Output | None, Output | None]]:
    """Outputs of one delivery side by side: per topic, in order."""
    others: dict[str, deque[Output]] = defaultdict(deque)
    for output in changed:
        others[output.topic.name].append(output)
    pairs: list[tuple[Output | None, Output | None]] = []
    for output in outputs:
        queue = others[output.topic.name]
        pairs.append((output, queue.popleft() if queue else None))
    return pairs + [(None, o) for queue in others.values() for o in queue]


def _decoded(entry: Message) -> Any:
    """The message with arrays as a node makes them: aligned, for kernels are compiled for that."""
    assert entry.payload is not None
    try:
        message = decode(entry.payload, topics.BY_NAME[entry.topic].type)
    except (ValueError, TypeError) as error:
        raise LogDamaged(f"{_place(entry)}: {error}") from error
    parts = {slot: getattr(message, slot) for slot in message.__slots__}
    return freeze(type(message)(**{k: v.copy() if isinstance(v, np.ndarray) else v for k, v in parts.items()}))


def _place(entry: Message) -> str:
    try:
        stamp = f"stamp {decode(entry.payload, topics.BY_NAME[entry.topic].type).stamp_ns}" if entry.payload else ""
    except (ValueError, TypeError):
        stamp = ""
    return f"{entry.topic} of {entry.source}, {stamp or 'stamp unreadable'}, at {entry.time_ns * 1e-9:.6f} s"


def _difference(entry: Message, message: Any, what: tuple[str, ...]) -> Difference:
    stamp_ns = -1 if message is None else message.stamp_ns
    return Difference(entry.source, entry.topic, entry.time_ns, stamp_ns, what)


def _extra(node: str, time_ns: int, pending: _Pending) -> Difference:
    output = pending.output
    what = ("the replay gives it, it is not logged",)
    return Difference(node, output.topic.name, time_ns, output.message.stamp_ns, what)
