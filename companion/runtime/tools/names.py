"""Topics, nodes and services as the tools show them, and found by what a user types."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from companion.core.errors import InputError
from companion.runtime.wire.keys import Entity, Kind


@dataclass(frozen=True, slots=True)
class View:
    """One topic with its publishers and subscriptions, or one service with its servers and clients."""

    name: str
    givers: tuple[Entity, ...]
    takers: tuple[Entity, ...]

    @property
    def types(self) -> tuple[str, ...]:
        """Names of all types that are spoken there; one, if nobody is at odds."""
        return tuple(dict.fromkeys(e.type for e in (*self.givers, *self.takers)))

    @property
    def hidden(self) -> bool:
        """ROS 2 hides names with a part that begins with an underscore."""
        return is_hidden(self.name)


def topics_of(entities: Iterable[Entity]) -> list[View]:
    """Every topic, in the order of names."""
    return _views(entities, "MP", "MS")


def services_of(entities: Iterable[Entity]) -> list[View]:
    """Every service, in the order of names."""
    return _views(entities, "SS", "SC")


def _views(entities: Iterable[Entity], giver: Kind, taker: Kind) -> list[View]:
    sides: dict[str, tuple[list[Entity], list[Entity]]] = {}
    for entity in entities:
        if entity.kind in (giver, taker):
            sides.setdefault(entity.topic, ([], []))[entity.kind == taker].append(entity)
    return [View(name, tuple(givers), tuple(takers)) for name, (givers, takers) in sorted(sides.items())]


def full_name(node: Entity) -> str:
    """Namespace and name: `/drone1/LioNode`."""
    return f"{node.namespace.rstrip('/')}/{node.node}"


def nodes_of(entities: Iterable[Entity]) -> dict[str, list[Entity]]:
    """Full name of each node -> its endpoints and itself; a name that two nodes bear holds those of both."""
    nodes: dict[str, list[Entity]] = {}
    for entity in entities:
        nodes.setdefault(full_name(entity), []).append(entity)
    return dict(sorted(nodes.items()))


def is_hidden(name: str) -> bool:
    """Whether ROS 2 hides the name."""
    return any(part.startswith("_") for part in name.split("/"))


def candidates(name: str, vehicle: str) -> tuple[str, ...]:
    """Full names that a user may mean: as given, and of the vehicle."""
    return (name,) if name.startswith("/") else (f"/{name}", f"/{vehicle}/{name}")


def find(name: str, known: Sequence[str], *, vehicle: str, what: str) -> str:
    """The full name that is there; InputError with the nearest ones, or with what is there at all."""
    for wanted in candidates(name, vehicle):
        if wanted in known:
            return wanted
    raise InputError(
        f"no {what} {name!r} is on the bus now", valid=_near(name, known, vehicle) or f"there is no {what}"
    )


def find_view(views: Sequence[View], name: str, *, vehicle: str, what: str = "topic") -> View:
    """The topic or service that a user means; InputError with the nearest names."""
    found = find(name, [v.name for v in views], vehicle=vehicle, what=what)
    return next(v for v in views if v.name == found)


def _near(name: str, known: Sequence[str], vehicle: str) -> str:
    """Names like it, whatever namespace was meant; else what there is."""

    def bare(full: str) -> str:
        return full.removeprefix(f"/{vehicle}/").strip("/")

    seen = {bare(k): k for k in known if not is_hidden(k)}
    wanted = bare(name)
    near = difflib.get_close_matches(wanted, seen, n=4, cutoff=0.7)
    near += [b for b in seen if wanted.rsplit("/", 1)[-1] in b and b not in near]
    return ", ".join(seen[b] for b in (near[:6] if wanted and near else list(seen)[:8]))
