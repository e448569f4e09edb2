"""The stack's clock beside a simulator that runs slower or faster than real time: set by its `/clock`."""

from __future__ import annotations

import time
from dataclasses import replace
from typing import Final

from companion.core.errors import LinkError
from companion.runtime.bus.graph import Arrival, Graph
from companion.runtime.clock import Clock
from companion.runtime.wire import wire_type
from companion.runtime.wire.keys import Qos
from companion.runtime.wire.parts import ns_of

SAMPLES: Final = 25  # half a second: the quickest of them sets the clock
TIMEOUT_S: Final = 10.0


def join_clock(graph: Graph, host: Clock, *, speed: float) -> Clock:
    """A clock that shows what the simulator's shows; raises LinkError if none tells the time."""
    if speed == 1.0:
        return host
    kind = wire_type("rosgraph_msgs/msg/Clock")
    heard: list[tuple[int, int]] = []  # (host, simulator), ns

    def take(arrival: Arrival) -> None:
        heard.append((host.now_ns(), ns_of(kind.decode(arrival.payload)["clock"])))

    graph.node("clock_follower").subscribe("/clock", kind, Qos(reliable=False, depth=1), take)
    until_s = time.monotonic() + TIMEOUT_S
    while len(heard) < SAMPLES:
        if time.monotonic() > until_s:
            raise LinkError("nobody tells the time on /clock: start `companion sim --speed` first, on the same bus")
        time.sleep(0.02)
    return set_by(list(heard), host, speed=speed)


def set_by(heard: list[tuple[int, int]], host: Clock, *, speed: float) -> Clock:
    """From (host, simulator) times, each late by what it took to come: the least late one counts."""
    host_ns, told_ns = max(heard, key=lambda pair: pair[1] - pair[0] * speed)
    return replace(host, speed=speed, since_ns=round((told_ns - host_ns * speed) / (1.0 - speed)))
