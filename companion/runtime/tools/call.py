"""Call a service of any ROS 2 node."""

from __future__ import annotations

from typing import Any

from companion.core.errors import CompanionError, InputError
from companion.runtime.tools.desk import Desk
from companion.runtime.tools.kinds import service_kind
from companion.runtime.tools.names import find_view, services_of
from companion.runtime.tools.values import stamped
from companion.runtime.wire import ServiceType
from companion.runtime.wire.keys import Entity


def find_service(desk: Desk, name: str, type_: str, *, vehicle: str) -> tuple[str, ServiceType]:
    """Full name and type of a service that is served; InputError for a wrong name or type."""
    everyone: list[Entity] = desk.entities()
    served = [view for view in services_of(everyone) if view.givers]
    view = find_view(served, name, vehicle=vehicle, what="service")
    if type_ and type_ not in view.types:
        raise InputError(f"{view.name} is of another type than {type_}", field="TYPE", valid=", ".join(view.types))
    return view.name, service_kind(desk, view.givers, everyone)


def call(desk: Desk, name: str, kind: ServiceType, values: dict[str, Any], *, timeout_s: float) -> dict[str, Any]:
    """Ask once; CompanionError if nobody answers in time, or the answer is an error."""
    now_ns = desk.clock.now_ns()
    request = kind.request.encode(kind.request.complete(stamped(kind.request, values, now_ns)))
    reply = desk.node.call(name, kind, request, stamp_ns=now_ns, timeout_s=timeout_s)
    if reply is None:
        raise CompanionError(f"{name} did not answer within {timeout_s:g} s")
    return kind.response.decode(reply)
