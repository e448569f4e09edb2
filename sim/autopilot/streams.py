"""When each telemetry message is due; MAV_CMD_SET_MESSAGE_INTERVAL changes it."""

from __future__ import annotations

import heapq
from collections.abc import Mapping
from typing import Final

import numpy as np

NS: Final = 1_000_000_000


class Streams:
    """A queue of (due time, message id); phases are drawn from the seed so that not all come at once."""

    def __init__(self, rates_hz: Mapping[int, float], rng: np.random.Generator) -> None:
        self._default = {msg_id: round(NS / rate) for msg_id, rate in rates_hz.items()}
        self.period_ns = dict(self._default)
        phases = {i: int(rng.integers(period)) for i, period in self._default.items()}
        self._queue = [(phase, msg_id) for msg_id, phase in phases.items()]
        heapq.heapify(self._queue)

    def due(self, now_ns: int) -> list[int]:
        """Ids to send now, in order; each once, however late we are."""
        ready: list[int] = []
        queue = self._queue
        while queue and queue[0][0] <= now_ns:
            due, msg_id = queue[0]
            period = self.period_ns[msg_id]
            following = due + period if due + period > now_ns else now_ns + period
            heapq.heapreplace(queue, (following, msg_id))
            ready.append(msg_id)
        return ready

    def set_interval(self, now_ns: int, msg_id: int, interval_us: float, *, known: bool) -> bool:
        """Microseconds; 0: the default rate, negative: off. False if the message cannot be streamed."""
        if not known or interval_us != interval_us:
            return False
        self._queue = [entry for entry in self._queue if entry[1] != msg_id]
        self.period_ns.pop(msg_id, None)
        interval_us = min(interval_us, 2.0**31 - 1)  # what MESSAGE_INTERVAL can say
        period = self._default.get(msg_id, 0) if interval_us == 0 else max(round(interval_us * 1e3), 2_500_000)
        if interval_us >= 0 and period > 0:
            self.period_ns[msg_id] = period
            self._queue.append((now_ns + period, msg_id))
        heapq.heapify(self._queue)
        return True
