"""Quality of service as ROS 2 tells it, and rmw_zenoh writes it into liveliness tokens."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from companion.core.node import Topic
from companion.runtime.wire.errors import WireError

_DEFAULT_DEPTH = 42  # rmw_zenoh's own; it stands for empty in the token
_MAX_NS = 2**63 - 1
HISTORY_DEPTH = 256  # samples for who comes late: four minutes of map deltas


@dataclass(frozen=True, slots=True)
class Qos:
    """ROS 2 QoS profile; None is an infinite duration, `liveliness` ROS's number (0: default)."""

    reliable: bool = True
    transient_local: bool = False
    keep_all: bool = False
    depth: int = _DEFAULT_DEPTH
    deadline_ns: int | None = None
    lifespan_ns: int | None = None
    liveliness: int = 0
    lease_ns: int | None = None

    @property
    def chunk(self) -> str:
        """The last part of a token: only what differs from the default stands there."""
        depth = "" if self.depth == _DEFAULT_DEPTH else str(self.depth)
        liveliness = str(self.liveliness) if self.liveliness else ""
        return (
            f"{'' if self.reliable else 2}:{1 if self.transient_local else ''}:{2 if self.keep_all else ''},{depth}"
            f":{_duration(self.deadline_ns)}:{_duration(self.lifespan_ns)}:{liveliness},{_duration(self.lease_ns)}"
        )


def parse_qos(chunk: str) -> Qos:
    """Inverse of `Qos.chunk`; WireError if it is none."""
    try:
        reliability, durability, history, deadline, lifespan, liveliness = chunk.split(":")
        kind, depth = history.split(",")
        liveliness, *lease = liveliness.split(",")
        return Qos(
            reliable=_number(reliability, 1) != 2,
            transient_local=_number(durability, 2) == 1,
            keep_all=_number(kind, 1) == 2,
            depth=_number(depth, _DEFAULT_DEPTH),
            deadline_ns=_nanoseconds(*deadline.split(",")),
            lifespan_ns=_nanoseconds(*lifespan.split(",")),
            liveliness=_number(liveliness, 0),
            lease_ns=_nanoseconds(*lease),
        )
    except (ValueError, TypeError):
        raise WireError(f"{chunk[:80]!r} is no QoS of a token") from None


def qos_of(topic: Topic[Any]) -> Qos:
    """What our publishers say of a topic, after its service class.

    Reliable here never means that a sender waits: on the bus all drop rather than block.
    """
    if topic.service == "bulk":
        return Qos(reliable=False, depth=5)  # sensor data
    if topic.service == "latched":
        return Qos(transient_local=True, depth=1)
    if topic.service == "history":
        return Qos(transient_local=True, depth=1 if topic.keep == "latest" else HISTORY_DEPTH)
    return Qos(depth=1 if topic.keep == "latest" else 10)


def _duration(value_ns: int | None) -> str:
    return "," if value_ns is None else "{},{}".format(*divmod(value_ns, 10**9))


def _nanoseconds(seconds: str, nanoseconds: str) -> int | None:
    if not seconds and not nanoseconds:
        return None
    value = _number(seconds, 0) * 10**9 + _number(nanoseconds, 0)
    return value if value < _MAX_NS else None


def _number(text: str, default: int) -> int:
    if not text:
        return default
    if not (text.isascii() and text.isdigit() and len(text) <= 20):
        raise ValueError
    return int(text)
