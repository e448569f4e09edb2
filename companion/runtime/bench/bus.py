"""Two processes over a bus of their own at a vehicle's full load: what it costs, how late, what is lost.

for row in bench_bus(for_s=20.0):
    print(row.latency_p99_ms, row.lost)
"""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from typing import Literal, get_args

import msgspec
import numpy as np

from companion.core.errors import CompanionError
from companion.runtime.bench.load import full_load
from companion.runtime.bench.side import Part, Tally, Way
from companion.runtime.bus.session import open_session
from companion.runtime.clock import Clock

WAYS: tuple[Way, ...] = get_args(Way)
WARM_S = 1.5  # sends before it counts
START_S = 60.0  # a side that is not there then, and done in time, is killed


class BusRow(msgspec.Struct, frozen=True, kw_only=True):
    """Figures of one way to use the bus."""

    way: Way
    for_s: float
    cpu_send_percent: float
    """Of one core, with encoding."""
    cpu_hear_percent: float
    """Of one core, with decoding."""
    latency_p50_ms: float
    """Setpoints, from before they are encoded until they are decoded."""
    latency_p99_ms: float
    latency_max_ms: float
    gap_p99_ms: float
    """Between arrivals of setpoints, which are sent every 20 ms."""
    messages_per_s: float
    mb_per_s: float
    sent: dict[str, int]
    lost: dict[str, int]
    ran_first: bool
    """Both sides ran before ordinary processes, as control does where the system allows it."""
    machine_load: float
    """Runnable processes on the machine in the minute before, of `cores`."""
    cores: int


def bench_bus(*, for_s: float, ways: Sequence[Way] = WAYS) -> Iterator[BusRow]:
    """One row after another, `for_s` seconds each; raises CompanionError if a side fails."""
    for way in ways:
        load = os.getloadavg()[0]
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            endpoint = f"tcp/127.0.0.1:{probe.getsockname()[1]}"
        with open_session("router", endpoint=endpoint):
            sender, receiver = _run(way, endpoint, for_s)
        yield _row(way, for_s, sender, receiver, load)


def _run(way: Way, endpoint: str, for_s: float) -> tuple[Tally, Tally]:
    """(what was sent, what was heard)."""
    clock = Clock.of_host()
    with ExitStack() as stack:
        hear, send = (_start(stack, side, way, endpoint, clock, for_s) for side in ("hear", "send"))
        _line(hear), _line(send)  # both are ready
        begin_ns = clock.now_ns() + round(WARM_S * 1e9)
        _say(hear, str(begin_ns))
        _say(send, str(begin_ns))
        heard, sent = (msgspec.json.decode(_line(process), type=Tally) for process in (hear, send))
    return sent, heard


def _start(
    stack: ExitStack, side: Literal["hear", "send"], way: Way, endpoint: str, clock: Clock, for_s: float
) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "companion.runtime.bench.side"]
    process = stack.enter_context(subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True))
    stack.callback(process.kill)
    watchdog = threading.Timer(START_S + WARM_S + for_s, process.kill)
    watchdog.start()
    stack.callback(watchdog.cancel)
    part = Part(side=side, way=way, endpoint=endpoint, clock_offset_ns=clock.offset_ns, for_s=for_s)
    _say(process, msgspec.json.encode(part).decode())
    return process


def _say(process: subprocess.Popen[str], line: str) -> None:
    assert process.stdin is not None
    process.stdin.write(line + "\n")
    process.stdin.flush()


def _line(process: subprocess.Popen[str]) -> str:
    assert process.stdout is not None
    line = process.stdout.readline()
    if not line:
        raise CompanionError(f"a side of the measurement ended with exit code {process.wait()}")
    return line


def _row(way: Way, for_s: float, sent: Tally, heard: Tally, load: float) -> BusRow:
    latency = np.array(heard.latency_ms or [np.nan])
    p50, p99 = np.percentile(latency, [50, 99])
    gap = np.percentile(heard.gap_ms, 99) if heard.gap_ms else np.nan
    order = [stream.topic.name for stream in full_load()]
    return BusRow(
        way=way,
        for_s=for_s,
        cpu_send_percent=round(100 * sent.cpu_s / for_s, 1),
        cpu_hear_percent=round(100 * heard.cpu_s / for_s, 1),
        latency_p50_ms=round(float(p50), 3),
        latency_p99_ms=round(float(p99), 3),
        latency_max_ms=round(float(latency.max()), 3),
        gap_p99_ms=round(float(gap), 2),
        messages_per_s=round(sum(heard.messages.values()) / for_s, 1),
        mb_per_s=round(heard.payload_bytes / for_s / 1e6, 2),
        sent={name: sent.messages.get(name, 0) for name in order},
        lost={name: sent.messages.get(name, 0) - heard.messages.get(name, 0) for name in order},
        ran_first=sent.ran_first and heard.ran_first,
        machine_load=round(load, 2),
        cores=os.cpu_count() or 1,
    )
