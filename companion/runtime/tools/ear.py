"""Samples of one topic on their way from Zenoh's thread to a tool's loop."""

from __future__ import annotations

import queue
import time
from collections.abc import Iterator
from dataclasses import dataclass
from threading import Event
from typing import NamedTuple

from companion.runtime.bus.graph import Arrival
from companion.runtime.tools.desk import Desk
from companion.runtime.tools.kinds import Named
from companion.runtime.tools.names import View
from companion.runtime.wire import WireType
from companion.runtime.wire.keys import Attachment, Qos

MOST_BYTES = 64_000_000  # that may wait, if the terminal is slow
OVERHEAD_BYTES = 500  # of a sample beside its payload
WAKE_S = 0.1  # how soon a Ctrl-C is noticed


class Heard(NamedTuple):
    """One sample; the times are those of its arrival."""

    payload: bytes
    attachment: Attachment | None
    monotonic_ns: int
    wall_ns: int


@dataclass(frozen=True, slots=True)
class Limits:
    """When a tool has had enough; 0 is never."""

    count: int = 0
    for_s: float = 0.0


class Ear:
    """Takes samples on any thread, gives them on one; what finds no room is left out and counted."""

    def __init__(self, *, most_bytes: int = MOST_BYTES) -> None:
        self.left_out = 0
        self._most = most_bytes
        self._queue: queue.SimpleQueue[Heard] = queue.SimpleQueue()
        self._put_bytes = self._taken_bytes = 0  # each written by one thread alone

    def put(self, arrival: Arrival) -> None:
        """Take a sample, at once."""
        if self._put_bytes - self._taken_bytes > self._most:
            self.left_out += 1
            return
        self._put_bytes += len(arrival.payload) + OVERHEAD_BYTES
        self._queue.put(Heard(arrival.payload, arrival.attachment, time.monotonic_ns(), time.time_ns()))

    def take(self, timeout_s: float) -> Heard | None:
        """The oldest sample, waiting for it if it must."""
        try:
            heard = self._queue.get(timeout=timeout_s)
        except queue.Empty:
            return None
        self._taken_bytes += len(heard.payload) + OVERHEAD_BYTES
        return heard

    def until(self, stopped: Event, limits: Limits, *, beat_s: float = 1.0) -> Iterator[Heard | None]:
        """Samples as they come, and None every `beat_s`: time to report; ends at the limits, or when stopped."""
        begin_s = time.monotonic()
        beat_at_s, taken = begin_s + beat_s, 0
        end_s = begin_s + limits.for_s if limits.for_s else float("inf")
        while not stopped.is_set():
            now_s = time.monotonic()
            if now_s >= end_s:
                return
            if now_s >= beat_at_s:
                beat_at_s += beat_s * ((now_s - beat_at_s) // beat_s + 1)
                yield None
            heard = self.take(max(0.0, min(WAKE_S, beat_at_s - now_s, end_s - now_s)))
            if heard is not None:
                taken += 1
                yield heard
                if taken == limits.count:
                    return


def listen(desk: Desk, topic: View, kind: WireType | Named, *, most_bytes: int = MOST_BYTES) -> Ear:
    """Subscribe as the topic's publishers offer: what they keep for late joiners comes first."""
    ear = Ear(most_bytes=most_bytes)
    givers = [e for e in topic.givers if e.type_hash == kind.type_hash]
    keeps = bool(givers) and all(e.qos.transient_local for e in givers)
    depth = max((e.qos.depth for e in givers if keeps), default=10)
    reliable = all(e.qos.reliable for e in givers)
    desk.node.subscribe(topic.name, kind, Qos(reliable=reliable, transient_local=keeps, depth=max(1, depth)), ear.put)
    return ear
