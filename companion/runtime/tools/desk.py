"""A tool's seat on the bus: a client session with one hidden node.

with Desk(endpoint) as desk:
    for topic in topics_of(desk.entities()):
        print(topic.name)
"""

from __future__ import annotations

import os
from pathlib import Path
from types import TracebackType

from companion.core.errors import InputError
from companion.runtime.bus.certificate_files import find_credentials
from companion.runtime.bus.directory import Directory
from companion.runtime.bus.graph import Graph, GraphNode
from companion.runtime.bus.session import ENDPOINT, open_session
from companion.runtime.clock import Clock
from companion.runtime.wire.keys import Entity

HIDDEN = "_companion_cli"  # as ros2's own tools hide: by the underscore


class Desk:
    """Raises LinkError if no bus is there; everything ends with the `with` block.

    A ground link (`tls/HOST:PORT`) wants `certs`: a folder of certificates, or DIR/NAME.
    """

    def __init__(self, endpoint: str = ENDPOINT, *, domain: int = 0, certs: Path | None = None) -> None:
        if "/" not in endpoint or ":" not in endpoint:
            raise InputError(f"{endpoint!r} is no Zenoh endpoint", field="--bus", valid="tcp/HOST:PORT, tls/HOST:PORT")
        credentials = find_credentials(certs) if certs is not None else None
        self.session = open_session("client", endpoint=endpoint, credentials=credentials)
        self.graph = Graph(self.session, domain=domain)
        self.node: GraphNode = self.graph.node(f"{HIDDEN}_{os.getpid()}")
        self.clock = Clock.of_host()
        self._directory = Directory(self.graph)
        self._own = str(self.session.zid())

    def entities(self) -> list[Entity]:
        """Everyone on the bus but this tool."""
        return [e for e in self._directory.entities() if e.zid != self._own]

    def __enter__(self) -> Desk:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.graph.__exit__(kind, error, at)
        self.session.close()  # type: ignore[no-untyped-call]
