"""The MAVLink link as the control group sees it: bytes of the stack out, bytes of the vehicle in."""

from __future__ import annotations

import sys
from types import TracebackType
from typing import Any

from companion.core import topics
from companion.core.messages import MavlinkBytes
from companion.core.node import Topic
from companion.runtime.clock import Clock
from companion.runtime.live import LiveGroup
from companion.runtime.ports.mavlink_link import open_link


class VehicleLink:
    """An outlet for MAVLINK_TX, a source of MAVLINK_RX; opened at once, so that a bad URL shows early."""

    def __init__(self, url: str, *, clock: Clock) -> None:
        self._group: LiveGroup | None = None
        self._link = open_link(url, self._received, clock=clock.now_ns, report=_say)

    def deliver_to(self, group: LiveGroup) -> None:
        """From now on what is received goes to this group."""
        self._group = group

    def publish(self, topic: Topic[Any], message: Any, now_ns: int) -> None:
        """Send what is for the vehicle."""
        if topic is topics.MAVLINK_TX:
            self._link.send(message.data)

    def figures(self) -> dict[str, float]:
        """How the link fares."""
        s = self._link.stats
        return {
            "link_connected": float(s.connected),
            "link_bytes_in": s.bytes_in,
            "link_bytes_out": s.bytes_out,
            "link_dropped": s.dropped,
            "link_foreign": s.foreign,
            "link_reconnects": s.reconnects,
        }

    def _received(self, data: bytes, stamp_ns: int) -> None:
        if self._group is not None:
            self._group.receive(topics.MAVLINK_RX, MavlinkBytes(stamp_ns=stamp_ns, data=data))

    def __enter__(self) -> VehicleLink:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self._link.close()


def _say(sentence: str) -> None:
    print(f"link: {sentence}", file=sys.stderr, flush=True)
