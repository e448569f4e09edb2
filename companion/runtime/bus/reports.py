"""What a supervisor tells every ROS 2 machine: `/diagnostics` once per second, and its events in `/rosout`."""

from __future__ import annotations

from collections.abc import Sequence

from companion.runtime.bus.attach import URGENCY
from companion.runtime.bus.graph import Graph
from companion.runtime.clock import Clock
from companion.runtime.diagnostics import TYPE, Diagnoses, GroupReport
from companion.runtime.wire import wire_type
from companion.runtime.wire.keys import Qos
from companion.runtime.wire.parts import time_of

PERIOD_NS = 1_000_000_000
WARN = 30  # rcl_interfaces/msg/Log
ROSOUT = Qos(transient_local=True, depth=1000)  # as ROS declares it


class Reports:
    """Publishes; `look` as often as you like."""

    def __init__(self, graph: Graph, *, clock: Clock, vehicle: str) -> None:
        node = graph.node("supervisor_reports", namespace=f"/{vehicle}")
        self.clock, self._vehicle = clock, vehicle
        self._array, self._log = wire_type(TYPE), wire_type("rcl_interfaces/msg/Log")
        self._diagnostics = node.publisher("/diagnostics", self._array, Qos(depth=10), URGENCY["state"])
        self._rosout = node.publisher("/rosout", self._log, ROSOUT, URGENCY["state"])
        self._diagnoses = Diagnoses(vehicle)
        self._due_ns = 0

    def look(self, groups: Sequence[GroupReport]) -> None:
        """Report, if a second has passed."""
        now_ns = self.clock.now_ns()
        if now_ns < self._due_ns:
            return
        self._due_ns = now_ns + PERIOD_NS
        value = self._diagnoses.array(groups, now_ns)
        if self._diagnostics.wanted:
            self._diagnostics.put(self._array.encode(value), now_ns)

    def event(self, text: str) -> None:
        """Something happened that an operator should know."""
        now_ns = self.clock.now_ns()
        name = f"{self._vehicle}.supervisor"
        value = {"stamp": time_of(now_ns), "level": WARN, "name": name, "msg": text}
        self._rosout.put(self._log.encode(value), now_ns)
