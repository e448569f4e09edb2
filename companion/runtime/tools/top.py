"""What `companion top` shows: the newest `/diagnostics`, and the nodes on the bus that nobody reports on."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

from companion.core.errors import CompanionError
from companion.runtime.diagnostics import TYPE
from companion.runtime.tools.desk import Desk
from companion.runtime.tools.ear import Ear
from companion.runtime.tools.names import full_name, is_hidden
from companion.runtime.wire import wire_type
from companion.runtime.wire.keys import Entity, Qos

TOPIC = "/diagnostics"
LEVELS = ("ok", "warn", "error", "stale")
OLD_S = 3.0  # three reports missed: what they said no longer holds


@dataclass(frozen=True, slots=True)
class Status:
    """One status of a stack's diagnostics; figures as numbers where they are numbers."""

    kind: str  # node, group, topic
    name: str
    vehicle: str
    level: str
    message: str
    values: dict[str, float | str] = field(default_factory=dict)

    def figure(self, key: str) -> float:
        """NaN if it was not told."""
        value = self.values.get(key, math.nan)
        return value if isinstance(value, float) else math.nan


@dataclass(frozen=True, slots=True)
class Picture:
    """Everything at one moment."""

    statuses: tuple[Status, ...]
    age_s: float  # of the newest report; inf if there was none
    others: tuple[str, ...]  # nodes without a report

    def of(self, kind: str) -> list[Status]:
        """The statuses of nodes, groups or topics."""
        return [s for s in self.statuses if s.kind == kind]

    @property
    def plain(self) -> dict[str, Any]:
        """For JSON."""
        rows = {
            f"{kind}s": [
                {"name": s.name, "vehicle": s.vehicle, "level": s.level, "message": s.message, **s.values}
                for s in self.of(kind)
            ]
            for kind in ("group", "node", "topic")
        }
        return {"age_s": self.age_s, **rows, "others": self.others}


class Top:
    """Listens to the diagnostics of every stack on the bus."""

    def __init__(self, desk: Desk) -> None:
        self._desk, self._kind, self._ear = desk, wire_type(TYPE), Ear()
        self._statuses: dict[str, Status] = {}
        self._heard_ns = 0
        self._others: tuple[str, ...] = ()
        desk.node.subscribe(TOPIC, self._kind, Qos(depth=10), self._ear.put)

    def wait(self, timeout_s: float) -> bool:
        """Take in what comes within the time; True as soon as a report has."""
        heard = self._ear.take(timeout_s)
        if heard is None:
            return False
        try:
            statuses = statuses_of(self._kind.decode(heard.payload))
        except CompanionError:
            return False  # a stranger's payload
        if statuses:
            vehicles = {s.vehicle for s in statuses}
            kept = {k: s for k, s in self._statuses.items() if s.vehicle not in vehicles}
            self._statuses = kept | {f"{s.vehicle}/{s.kind}/{s.name}": s for s in statuses}
            self._heard_ns = heard.monotonic_ns
        return bool(statuses)

    def look_around(self) -> None:
        """Ask who else is on the bus; takes up to a second."""
        reported = {(s.vehicle, s.name.rsplit("/", 1)[-1]) for s in self._statuses.values() if s.kind == "node"}
        groups = [s.name for s in self._statuses.values() if s.kind == "group"]
        helpers = (*(f"{group}_" for group in groups), *(("supervisor",) if groups else ()))
        self._others = tuple(others(self._desk.entities(), reported, helpers))

    def picture(self, monotonic_ns: int) -> Picture:
        """What is known now."""
        age_s = (monotonic_ns - self._heard_ns) * 1e-9 if self._heard_ns else math.inf
        return Picture(tuple(self._statuses.values()), age_s, self._others)


def statuses_of(array: dict[str, Any]) -> list[Status]:
    """Those of our stacks; other nodes' diagnostics have no kind."""
    found = []
    for status in array["status"]:
        values = {pair["key"]: _number(pair["value"]) for pair in status["values"]}
        kind = values.pop("kind", "")
        if isinstance(kind, str) and kind in ("node", "group", "topic"):
            name = status["name"].removeprefix(f"{status['hardware_id']}/").removeprefix("topics/")
            level = LEVELS[min(status["level"], len(LEVELS) - 1)]
            found.append(Status(kind, name, status["hardware_id"], level, status["message"], values))
    return found


def others(entities: Iterable[Entity], reported: set[tuple[str, str]], helpers: tuple[str, ...]) -> list[str]:
    """Full names of nodes that no report covers; nodes that serve a process group begin with one of `helpers`."""
    nodes = [e for e in entities if e.kind == "NN" and not is_hidden(full_name(e)) and not e.node.startswith(helpers)]
    return sorted({full_name(e) for e in nodes if (e.namespace.strip("/"), e.node) not in reported})


def _number(text: str) -> float | str:
    try:
        return float(text)
    except ValueError:
        return text
