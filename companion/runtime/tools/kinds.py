"""The type of what is on the bus: bundled, or told by the node that speaks it.

ROS 2 nodes serve `~/get_type_description`; what they answer is built into a type and counts
only if its hash is the one in the topic's key.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from companion.core.errors import CompanionError, InputError
from companion.runtime.tools.desk import Desk
from companion.runtime.tools.names import full_name
from companion.runtime.wire import ServiceType, WireError, WireType, bundled_types, service_type, wire_type
from companion.runtime.wire.described import described_library
from companion.runtime.wire.keys import Entity
from companion.runtime.wire.types import Types, dds_name

ASK = "type_description_interfaces/srv/GetTypeDescription"
ANSWER_S = 2.0


@dataclass(frozen=True, slots=True)
class Named:
    """A type of which only the names are known: enough to listen, not to read."""

    name: str
    type_hash: str

    @property
    def dds_name(self) -> str:
        """As in keys."""
        return dds_name(self.name)


def message_type(desk: Desk, spoken: Sequence[Entity], everyone: Sequence[Entity]) -> WireType:
    """The type of a topic's first endpoint; CompanionError if it is not bundled and nobody tells it."""
    first = spoken[0]
    if first.type in bundled_types() and wire_type(first.type).type_hash == first.type_hash:
        return wire_type(first.type)
    return _told(desk, [e for e in spoken if e.type_hash == first.type_hash], everyone)[first.type]


def service_kind(desk: Desk, spoken: Sequence[Entity], everyone: Sequence[Entity]) -> ServiceType:
    """The same of a service."""
    first = spoken[0]
    if first.type in bundled_types() and service_type(first.type).type_hash == first.type_hash:
        return service_type(first.type)
    return ServiceType(first.type, _told(desk, [e for e in spoken if e.type_hash == first.type_hash], everyone))


def _told(desk: Desk, spoken: Sequence[Entity], everyone: Sequence[Entity]) -> Types:
    problems = []
    for endpoint in spoken:
        try:
            answer = _ask(desk, endpoint, everyone)
            return Types(described_library(answer["type_description"], expect_hash=endpoint.type_hash))
        except (WireError, InputError) as error:
            problems.append(f"{full_name(endpoint)}: {error}")
    raise CompanionError(
        f"{spoken[0].type} is not bundled in this form, and no node tells what it is ({'; '.join(problems)}); "
        "--raw shows the bytes"
    )


def _ask(desk: Desk, endpoint: Entity, everyone: Sequence[Entity]) -> dict[str, Any]:
    kind = service_type(ASK)
    served = f"{full_name(endpoint)}/get_type_description"
    if not any(e.kind == "SS" and e.topic == served and e.type_hash == kind.type_hash for e in everyone):
        raise WireError("serves no get_type_description")
    request = {"type_name": endpoint.type, "type_hash": endpoint.type_hash, "include_type_sources": False}
    payload = kind.request.encode(request)
    reply = desk.node.call(served, kind, payload, stamp_ns=desk.clock.now_ns(), timeout_s=ANSWER_S)
    if reply is None:
        raise WireError(f"did not answer within {ANSWER_S:g} s")
    answer = kind.response.decode(reply)
    if not answer["successful"]:
        raise WireError(f"refused: {answer['failure_reason'] or 'without a reason'}")
    return answer
