"""How long a LiDAR sweep takes to become a MAVLink setpoint, and how evenly setpoints leave."""

from __future__ import annotations

from collections import deque
from typing import Any

import numpy as np

from companion.core import topics
from companion.core.node import Topic
from companion.runtime.live import InboxLog

SET_POSITION_TARGET_LOCAL_NED = 84
KEPT = 60_000  # 20 min of setpoints


class Latency:
    """An outlet that sends nothing: it looks at what passes, in the control group.

    The age of a setpoint is that of the newest LiDAR update inside the odometry that it was made
    from, at the moment when its bytes go to the link; each sweep counts once.
    """

    def __init__(self) -> None:
        self._sweeps: deque[int] = deque(maxlen=32)
        self._measured_ns = self._told_ns = self._sent_ns = 0
        self._ages_s: deque[float] = deque(maxlen=KEPT)
        self._gaps_s: deque[float] = deque(maxlen=KEPT)

    def publish(self, topic: Topic[Any], message: Any, now_ns: int) -> None:
        """Take note of odometry and of setpoints on the link."""
        if topic is topics.ODOMETRY:
            self._measured_ns = message.measured_ns
        elif topic is topics.MAVLINK_TX and _is_setpoint(message.data):
            if self._sent_ns:
                self._gaps_s.append((now_ns - self._sent_ns) * 1e-9)
            self._sent_ns = now_ns
            if self._measured_ns != self._told_ns and self._measured_ns in self._sweeps:
                self._told_ns = self._measured_ns
                self._ages_s.append((now_ns - self._measured_ns) * 1e-9)

    def heard(self, topic: Topic[Any], message: Any) -> None:
        """Which stamps are those of sweeps."""
        if topic is topics.LIO_STATE and message.source == "lidar":
            self._sweeps.append(message.stamp_ns)

    def figures(self) -> dict[str, float]:
        """Percentiles in ms, and how many they are of."""
        return {
            **_percentiles("sweep_to_setpoint", self._ages_s),
            **_percentiles("setpoint_gap", self._gaps_s),
        }


class HearingLog:
    """A log that lets someone hear what comes from outside."""

    def __init__(self, log: InboxLog, listener: Latency) -> None:
        self._log, self._listener = log, listener
        self.published, self.fed = log.published, log.fed

    def received(self, now_ns: int, topic: Topic[Any], message: Any) -> int:
        """To the listener, then to the log."""
        self._listener.heard(topic, message)
        return self._log.received(now_ns, topic, message)


def _is_setpoint(data: bytes) -> bool:
    return len(data) > 9 and int.from_bytes(data[7:10], "little") == SET_POSITION_TARGET_LOCAL_NED


def _percentiles(name: str, values_s: deque[float]) -> dict[str, float]:
    if not values_s:
        return {}
    p50, p99, most = (np.percentile(np.array(values_s), [50, 99, 100]) * 1e3).tolist()
    return {f"{name}_p50_ms": p50, f"{name}_p99_ms": p99, f"{name}_max_ms": most, f"{name}_count": len(values_s)}
