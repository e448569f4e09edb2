"""Publish values that a user gave: to whom, how often, and until when."""

from __future__ import annotations

import time
from collections.abc import Iterator
from threading import Event
from typing import Any

from companion.core.errors import InputError, LinkError
from companion.runtime.bus.graph import Publisher
from companion.runtime.tools.desk import Desk
from companion.runtime.tools.ear import Limits
from companion.runtime.tools.kinds import message_type
from companion.runtime.tools.names import candidates, topics_of
from companion.runtime.tools.values import stamped
from companion.runtime.wire import WireType, bundled_types, wire_type
from companion.runtime.wire.keys import Entity, Qos

LOOK_S = 0.1
SETTLE_S = 0.05  # a subscription that has just been seen may still be on its way to us


def topic_to_publish(entities: list[Entity], name: str, vehicle: str) -> str:
    """The topic that is there and meant by the name; a new one bears the name as given."""
    known = {view.name for view in topics_of(entities)}
    wanted = candidates(name, vehicle)
    return next((n for n in wanted if n in known), wanted[0])


def type_to_publish(desk: Desk, entities: list[Entity], topic: str, name: str) -> WireType:
    """The bundled type, or that of the topic's other endpoints; InputError if they speak another one."""
    ends = [e for e in entities if e.topic == topic and e.kind in ("MP", "MS")]
    same = [e for e in ends if e.type == name]
    if ends and not same:
        spoken = ", ".join(dict.fromkeys(e.type for e in ends))
        raise InputError(f"{topic} is of another type than {name}", field="TYPE", valid=spoken)
    if same and (name not in bundled_types() or wire_type(name).type_hash not in {e.type_hash for e in same}):
        return message_type(desk, same, entities)
    return wire_type(name)


def await_subscriptions(
    desk: Desk, publisher: Publisher, topic: str, kind: WireType, *, wanted: int, timeout_s: float, stopped: Event
) -> None:
    """Wait until so many listen; LinkError if they do not come in time."""
    until_s = time.monotonic() + timeout_s
    while wanted and not stopped.is_set():
        heard_by = sum(e.kind == "MS" and e.topic == topic and e.type_hash == kind.type_hash for e in desk.entities())
        if heard_by >= wanted and (publisher.matched):
            stopped.wait(SETTLE_S)
            return
        if time.monotonic() > until_s:
            raise LinkError(
                f"{heard_by} of {wanted} subscriptions to {topic} after {timeout_s:g} s: -w 0 publishes without waiting"
            )
        stopped.wait(LOOK_S)


def publish(
    desk: Desk, publisher: Publisher, kind: WireType, value: dict[str, Any], *, rate_hz: float, limits: Limits,
    stopped: Event,
) -> Iterator[dict[str, Any]]:  # fmt: skip
    """Put the value at a rate, its stamps made anew each time; yields what was sent."""
    begin_s, sent = time.monotonic(), 0
    while not stopped.is_set():
        now_ns = desk.clock.now_ns()
        full = kind.complete(stamped(kind, value, now_ns))
        publisher.put(kind.encode(full), now_ns)
        sent += 1
        yield full
        if sent == limits.count:
            return
        next_s = sent / rate_hz
        over = 0 < limits.for_s <= next_s
        stopped.wait(max(0.0, begin_s + (limits.for_s if over else next_s) - time.monotonic()))
        if over:
            return


def qos(reliability: str, durability: str, depth: int) -> Qos:
    """A profile from ros2's words; InputError for another word."""
    for field, word, valid in (
        ("--qos-reliability", reliability, ("reliable", "best_effort")),
        ("--qos-durability", durability, ("volatile", "transient_local")),
    ):
        if word not in valid:
            raise InputError(f"{word!r} is none", field=field, valid=", ".join(valid))
    return Qos(reliable=reliability == "reliable", transient_local=durability == "transient_local", depth=depth)
