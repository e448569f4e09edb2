"""A bad line for tests: a UDP middleman that drops, delays, doubles and reorders by a seeded generator.

    with Middleman(towards=("127.0.0.1", 14540), seed=1) as line:
        start_vehicle(f"udpout://127.0.0.1:{line.port}")   # the stack listens on 14540 as always
        line.both_ways(Faults(loss=0.5, delay_s=0.2))      # from now on
        line.down = Faults(loss=1.0)                       # only stack -> vehicle

The n-th datagram of a direction meets the same fate in every run; when it comes is the line's own time.
"""

from __future__ import annotations

import heapq
import select
import socket
import threading
import time
from dataclasses import dataclass
from types import TracebackType

import numpy as np

Address = tuple[str, int]
LATE_S = 0.05  # how much later a reordered datagram comes


@dataclass(frozen=True, slots=True, kw_only=True)
class Faults:
    """What happens to a datagram; probabilities 0..1, independent of each other."""

    loss: float = 0.0
    duplicate: float = 0.0
    reorder: float = 0.0  # held back LATE_S longer, so that those behind overtake it
    delay_s: float = 0.0
    jitter_s: float = 0.0  # up to so much more, uniform


@dataclass(slots=True)
class Count:
    """Datagrams of one direction."""

    taken: int = 0
    lost: int = 0
    doubled: int = 0
    held_back: int = 0
    passed: int = 0


class Middleman:
    """Between a vehicle that sends to `port` and a stack that listens at `towards`."""

    def __init__(self, *, towards: Address, seed: int, faults: Faults | None = None) -> None:
        self.up = self.down = faults or Faults()  # vehicle -> stack, stack -> vehicle
        self.up_count, self.down_count = Count(), Count()
        self.to_vehicle: list[tuple[float, bytes]] = []  # (monotonic s, datagram) of everything that went down
        self._towards, self._vehicle = towards, None
        self._rng = {"up": np.random.default_rng([seed, 0]), "down": np.random.default_rng([seed, 1])}
        self._front, self._back = self._socket(), self._socket()
        self.port: int = self._front.getsockname()[1]
        self._queue: list[tuple[float, int, str, bytes]] = []  # due, order, direction, datagram
        self._order = 0
        self._wake, self._woken = socket.socketpair()
        self._thread = threading.Thread(target=self._run, name="middleman")

    @staticmethod
    def _socket() -> socket.socket:
        sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        sock.bind(("127.0.0.1", 0))
        sock.setblocking(False)
        return sock

    def both_ways(self, faults: Faults) -> None:
        """From now on, in both directions."""
        self.up = self.down = faults

    def __enter__(self) -> Middleman:
        self._thread.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self._wake.send(b"x")
        self._thread.join()
        for sock in (self._front, self._back, self._wake, self._woken):
            sock.close()

    def _run(self) -> None:
        while True:
            wait_s = max(0.0, self._queue[0][0] - time.monotonic()) if self._queue else None
            ready, _, _ = select.select([self._front, self._back, self._woken], [], [], wait_s)
            if self._woken in ready:
                return
            if self._front in ready:
                self._take("up", self._front)
            if self._back in ready:
                self._take("down", self._back)
            while self._queue and self._queue[0][0] <= time.monotonic():
                self._pass_on(*heapq.heappop(self._queue)[2:])

    def _take(self, direction: str, sock: socket.socket) -> None:
        while True:
            try:
                data, address = sock.recvfrom(65536)
            except BlockingIOError:
                return
            except ConnectionError:  # nobody listened to the last one
                continue
            if direction == "up":
                self._vehicle = address
            self._decide(direction, data)

    def _decide(self, direction: str, data: bytes) -> None:
        faults, count = (self.up, self.up_count) if direction == "up" else (self.down, self.down_count)
        lost, doubled, held, *jitters = self._rng[direction].random(5)  # five per datagram, whatever the faults
        count.taken += 1
        if lost < faults.loss:
            count.lost += 1
            return
        late_s = LATE_S if held < faults.reorder else 0.0
        copies = 2 if doubled < faults.duplicate else 1
        count.held_back += late_s > 0
        count.doubled += copies - 1
        for jitter in jitters[:copies]:
            due = time.monotonic() + faults.delay_s + late_s + jitter * faults.jitter_s
            self._order += 1
            heapq.heappush(self._queue, (due, self._order, direction, data))

    def _pass_on(self, direction: str, data: bytes) -> None:
        target, sock, count = self._towards, self._back, self.up_count
        if direction == "down":
            target, sock, count = self._vehicle, self._front, self.down_count
        if target is None:
            return
        try:
            sock.sendto(data, target)
            count.passed += 1
            if direction == "down":
                self.to_vehicle.append((time.monotonic(), data))
        except OSError:
            count.lost += 1
