"""One side of `companion bench bus`: `python -m companion.runtime.bench.side`, a process of its own.

Its standard input brings a `Part`, then the time to begin; its standard output says `ready`, then a `Tally`.
"""

from __future__ import annotations

import queue
import struct
import sys
import threading
import time
from collections import Counter
from contextlib import ExitStack
from functools import partial
from itertools import pairwise
from typing import Any, Literal, NamedTuple

import msgspec
import zenoh

from companion.core.node import Topic
from companion.runtime.bench.load import Stream, full_load
from companion.runtime.bus.attach import URGENCY, BusOutlet, Hearing
from companion.runtime.bus.graph import Graph, Urgency
from companion.runtime.bus.session import configured, open_session
from companion.runtime.clock import Clock
from companion.runtime.priority import run_first
from companion.runtime.wire import codec_of

Way = Literal["classes", "defaults", "raw bytes"]
TIMED = "tracking/setpoint"
VEHICLE = "bench"
TAIL_S = 1.0  # the receiver listens so much longer
_STAMP = struct.Struct("<q")


class Part(msgspec.Struct, frozen=True, kw_only=True):
    """What a side has to do."""

    side: Literal["send", "hear"]
    way: Way
    endpoint: str
    clock_offset_ns: int
    for_s: float


class Tally(msgspec.Struct, frozen=True, kw_only=True):
    """What a side saw of the messages stamped within the time."""

    cpu_s: float
    messages: dict[str, int]
    payload_bytes: int = 0
    ran_first: bool = False
    """Before ordinary processes."""
    latency_ms: list[float] = []
    """Of each setpoint, from before it is encoded until it is decoded."""
    gap_ms: list[float] = []
    """Between arrivals of setpoints."""


def main() -> None:
    """Do what the first line of standard input says."""
    part = msgspec.json.decode(sys.stdin.readline(), type=Part)
    first = run_first()  # as control does: others on this machine shall not be what is measured
    with ExitStack() as stack:
        side = _sender(part, stack) if part.side == "send" else _receiver(part, stack)
        print("ready", flush=True)
        begin_ns = int(sys.stdin.readline())
        tally = side(begin_ns)
    tally = msgspec.structs.replace(tally, ran_first=first)
    print(msgspec.json.encode(tally).decode(), flush=True)


def _sender(part: Part, stack: ExitStack) -> Any:
    clock, streams = Clock(part.clock_offset_ns), full_load()
    outlet = _outlet(part.way, streams, _session(part, stack), stack)
    return partial(_send, streams, outlet, clock, round(part.for_s * 1e9))


def _receiver(part: Part, stack: ExitStack) -> Any:
    ears, session = Ears(Clock(part.clock_offset_ns)), _session(part, stack)
    heard = [stream.topic for stream in full_load()]
    if part.way == "raw bytes":
        for topic in heard:
            stack.callback(session.declare_subscriber(_raw_key(topic), partial(ears.receive_raw, topic)).undeclare)
    else:
        Hearing(stack.enter_context(Graph(session)), heard, ears, listener="ear", vehicle=VEHICLE)
    return partial(ears.listen, for_ns=round(part.for_s * 1e9))


def _session(part: Part, stack: ExitStack) -> zenoh.Session:
    if part.way == "classes":
        return stack.enter_context(open_session("peer", endpoint=part.endpoint))
    plain = {
        "mode": "peer",
        "connect/endpoints": [part.endpoint],
        "listen/endpoints": ["tcp/127.0.0.1:0"],
        "scouting/multicast/enabled": False,
        "timestamping/enabled": True,
    }
    return stack.enter_context(zenoh.open(configured(plain)))


def _outlet(way: Way, streams: tuple[Stream, ...], session: zenoh.Session, stack: ExitStack) -> BusOutlet | RawOutlet:
    if way == "raw bytes":
        return RawOutlet(session, streams, stack)
    urgency = URGENCY if way == "classes" else dict.fromkeys(URGENCY, Urgency())
    graph = stack.enter_context(Graph(session))
    return BusOutlet(graph, {"mouth": [s.topic for s in streams]}, vehicle=VEHICLE, urgency=urgency)


class RawOutlet:
    """Bytes of the same sizes, as Zenoh sends them by default: no codec, no attachment, no token."""

    def __init__(self, session: zenoh.Session, streams: tuple[Stream, ...], stack: ExitStack) -> None:
        self.sent: Counter[str] = Counter()
        self._rest = {s.topic.name: bytes(len(codec_of(s.topic).encode(s.make(0))) - _STAMP.size) for s in streams}
        self._publishers: dict[str, Any] = {s.topic.name: session.declare_publisher(_raw_key(s.topic)) for s in streams}
        for publisher in self._publishers.values():
            stack.callback(publisher.undeclare)

    def publish(self, topic: Topic[Any], message: Any, now_ns: int) -> None:
        """The stamp, then as many bytes as the message would have."""
        publisher = self._publishers[topic.name]
        if publisher.matching_status.matching:
            publisher.put(_STAMP.pack(message.stamp_ns) + self._rest[topic.name])
            self.sent[topic.name] += 1


def _raw_key(topic: Topic[Any]) -> str:
    return f"raw/{topic.name}"


def _send(
    streams: tuple[Stream, ...], outlet: BusOutlet | RawOutlet, clock: Clock, for_ns: int, begin_ns: int
) -> Tally:
    """Setpoints have a thread of their own, as they have a process of their own in flight."""
    timed = tuple(s for s in streams if s.topic.name == TIMED)
    rest = tuple(s for s in streams if s.topic.name != TIMED)
    counted: Counter[str] = Counter()
    span = Span(clock.now_ns(), begin_ns, begin_ns + for_ns)
    threads = [
        threading.Thread(target=_speak, args=(some, outlet, clock, span, counted), daemon=True)
        for some in (timed, rest)
    ]
    for thread in threads:
        thread.start()
    time.sleep(max(0.0, (begin_ns - clock.now_ns()) * 1e-9))
    cpu_s = time.process_time()
    for thread in threads:
        thread.join()
    return Tally(cpu_s=time.process_time() - cpu_s, messages=dict(counted))


class Span(NamedTuple):
    """When to speak, and from when on it counts; ns."""

    first_ns: int
    begin_ns: int
    end_ns: int


def _speak(
    streams: tuple[Stream, ...], outlet: BusOutlet | RawOutlet, clock: Clock, span: Span, counted: Counter[str]
) -> None:
    """Each stream at its rate; what is late is sent at once, and nothing is left out."""
    due_ns = [span.first_ns] * len(streams)
    while True:
        next_ns = min(due_ns)
        time.sleep(max(0.0, (next_ns - clock.now_ns()) * 1e-9))
        k = due_ns.index(next_ns)
        stamp_ns, name = clock.now_ns(), streams[k].topic.name
        if stamp_ns >= span.end_ns:
            return
        before = outlet.sent[name]
        outlet.publish(streams[k].topic, streams[k].make(stamp_ns), stamp_ns)
        if stamp_ns >= span.begin_ns:
            counted[name] += outlet.sent[name] - before
        due_ns[k] += round(1e9 / streams[k].rate_hz)


class Ears:
    """Takes payloads on Zenoh's thread, decodes them on its own."""

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._waiting: queue.SimpleQueue[tuple[Topic[Any], bytes, Any]] = queue.SimpleQueue()

    def receive(self, topic: Topic[Any], message: bytes, *, decode: Any) -> None:
        """Put a payload away."""
        self._waiting.put((topic, message, decode))

    def receive_raw(self, topic: Topic[Any], sample: zenoh.Sample) -> None:
        """Put raw bytes away."""
        self._waiting.put((topic, sample.payload.to_bytes(), None))

    def listen(self, begin_ns: int, *, for_ns: int) -> Tally:
        """Decode until all that is stamped within the time must have come."""
        end_ns = begin_ns + for_ns
        messages: Counter[str] = Counter()
        payload_bytes, cpu_s, cpu_end_s = 0, 0.0, 0.0
        latency_ms: list[float] = []
        arrived_ns: list[int] = []
        while (now_ns := self._clock.now_ns()) < end_ns + TAIL_S * 1e9:
            if not cpu_s and now_ns >= begin_ns:
                cpu_s = time.process_time()
            if not cpu_end_s and now_ns >= end_ns:
                cpu_end_s = time.process_time()
            try:
                topic, payload, decode = self._waiting.get(timeout=0.05)
            except queue.Empty:
                continue
            stamp_ns = decode(payload).stamp_ns if decode else _STAMP.unpack_from(payload)[0]
            if not begin_ns <= stamp_ns < end_ns:
                continue
            messages[topic.name] += 1
            payload_bytes += len(payload)
            if topic.name == TIMED:
                arrived_ns.append(self._clock.now_ns())
                latency_ms.append((arrived_ns[-1] - stamp_ns) * 1e-6)
        gaps = [(b - a) * 1e-6 for a, b in pairwise(arrived_ns)]
        return Tally(
            cpu_s=cpu_end_s - cpu_s,
            messages=dict(messages),
            payload_bytes=payload_bytes,
            latency_ms=latency_ms,
            gap_ms=gaps,
        )


if __name__ == "__main__":
    main()
