"""Run nodes in lockstep at the pace of a clock: the simulator beside a live stack.

    paced = Paced([node], pace=Pace(clock.now_ns()), outlets=[bus])
    while not stopped:
        next_ns = paced.step(clock.now_ns())  # 2.5 ms of simulated time, if they are due
        sleep until next_ns

Simulated time starts at 0; what goes out carries stamps of the clock. When the machine is too
slow the simulation slips: the clock's time that is lost is left out, never caught up.
"""

from __future__ import annotations

import dataclasses
from collections import deque
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np

from companion.core.node import Node, Output, Topic
from companion.runtime.live import Outlet
from companion.runtime.lockstep import Lockstep

STEP_NS = 2_500_000
PATIENCE_NS = 200_000_000  # so much is still caught up
LOOK_AGAIN_NS = 2_500_000  # for a message that was not ready when it was due
OUTSIDE = "runtime"  # the source of what was posted


class Pace:
    """Which simulated time is due at a time of the clock, and the way back for stamps."""

    def __init__(self, start_ns: int, *, speed: float = 1.0) -> None:
        self._start_ns, self._speed = start_ns, speed
        self.slips = 0
        self.slipped_ns = 0  # simulated time left out
        self._shifts: deque[tuple[int, int]] = deque([(-1, 0)], maxlen=64)  # (after this simulated time, shift)

    def due_ns(self, clock_ns: int) -> int:
        """Simulated time that should be reached now."""
        return round((clock_ns - self._start_ns) * self._speed) - self.slipped_ns

    def clock_ns(self, sim_ns: int) -> int:
        """When a simulated time is due; the inverse of `due_ns`."""
        return self._start_ns + round((sim_ns + self.slipped_ns) / self._speed)

    def stamp_ns(self, sim_ns: int) -> int:
        """Stamp of a simulated time; it runs at the simulation's speed from the clock's time of the start.

        A slip moves the stamps of what is later than it, not of what was sampled before.
        """
        shift = next((shift for after, shift in reversed(self._shifts) if sim_ns > after), 0)
        return self._start_ns + sim_ns + shift

    def slip(self, sim_ns: int, by_ns: int) -> None:
        """Leave out `by_ns` of simulated time after `sim_ns`."""
        self.slips += 1
        self.slipped_ns += by_ns
        self._shifts.append((sim_ns, self.slipped_ns))


class Paced:
    """Nodes in lockstep with a clock that is told at every step."""

    def __init__(
        self,
        nodes: Sequence[Node],
        *,
        pace: Pace,
        outlets: Sequence[Outlet],
        delays_ns: Mapping[str, Mapping[str, int]] | None = None,
    ) -> None:
        self.pace = pace
        self.lockstep = PatientLockstep(nodes, delays_ns=delays_ns or {}, tap=_Outward(pace, outlets))
        self._posted: deque[Output] = deque()
        self._late_ns: deque[int] = deque(maxlen=60 * 400)

    def post(self, output: Output) -> None:
        """A message from outside, from any thread; the next step publishes it."""
        self._posted.append(output)

    def step(self, clock_ns: int) -> int:
        """Advance by one step if it is due; returns the clock's time of the next."""
        start_ns = self.lockstep.now_ns
        late_ns = self.pace.due_ns(clock_ns) - start_ns - STEP_NS
        if late_ns >= 0:
            self._late_ns.append(late_ns)
            if late_ns > PATIENCE_NS:
                self.pace.slip(start_ns, late_ns)
            while self._posted:
                self.lockstep.publish(self._posted.popleft(), source=OUTSIDE)
            self.lockstep.run_until(start_ns + STEP_NS)
        return self.pace.clock_ns(self.lockstep.now_ns + STEP_NS)

    def late_ms(self, percent: float) -> float:
        """Percentile of how late steps began, in simulated ms, over the last 24000 steps (a minute)."""
        return float(np.percentile(self._late_ns, percent)) * 1e-6 if self._late_ns else 0.0


class PatientLockstep(Lockstep):
    """Delivers a message late if it is not ready when it is due, rather than wait for it."""

    def __init__(self, nodes: Sequence[Node], *, delays_ns: Mapping[str, Mapping[str, int]], tap: _Outward) -> None:
        super().__init__(nodes, delays_ns=delays_ns, tap=tap)
        self.late: dict[str, int] = {}  # topic -> messages that came late

    def _deliver(self, source: str, output: Output) -> None:
        if not hasattr(output.message, "result") or output.message.ready():
            super()._deliver(source, output)
            return
        self.late[output.topic.name] = self.late.get(output.topic.name, 0) + 1
        self._look_again(source, output)

    def _look_again(self, source: str, output: Output) -> None:
        if output.message.ready():
            super()._deliver(source, output)
        else:
            self._at(self.now_ns + LOOK_AGAIN_NS, partial(self._look_again, source, output))


class _Outward:
    """Hands to the outlets what the nodes publish, with the clock's stamps."""

    def __init__(self, pace: Pace, outlets: Sequence[Outlet]) -> None:
        self._pace, self._outlets = pace, outlets
        self._count = 0

    def published(self, now_ns: int, source: str, topic: Topic[Any], message: Any) -> int:
        if source != OUTSIDE:
            stamped = dataclasses.replace(message, stamp_ns=self._pace.stamp_ns(message.stamp_ns))
            for outlet in self._outlets:
                outlet.publish(topic, stamped, self._pace.stamp_ns(now_ns))
        self._count += 1
        return self._count - 1

    def fed(self, now_ns: int, node: str, event: str, number: int) -> None:
        """Nobody asks."""
