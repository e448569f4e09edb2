"""Everything that is said on the bus, into a recorder: topics that appear later, too."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from fnmatch import fnmatch

from companion.core.errors import CompanionError
from companion.runtime.bus.graph import Arrival
from companion.runtime.mcap_file import Sample, offered
from companion.runtime.recorder import Recorder
from companion.runtime.tools.desk import Desk
from companion.runtime.tools.kinds import message_type
from companion.runtime.tools.names import View, candidates, topics_of
from companion.runtime.wire import WireType
from companion.runtime.wire.keys import Qos

HEAVY = ("*/mapping/local_map",)  # 100 MB a second: only for who asks for it by name


class BusRecording:
    """Subscribes to topics and hands what comes to a recorder, undecoded.

    `wanted` are names, or patterns with `*`; none: every topic that is neither hidden nor heavy.
    """

    def __init__(self, desk: Desk, recorder: Recorder, *, wanted: Sequence[str] = (), vehicle: str = "drone1") -> None:
        self.topics: dict[str, str] = {}  # name -> type, of what is recorded
        self.refused: dict[str, str] = {}  # name -> why it cannot be recorded
        self._desk, self._recorder = desk, recorder
        self._wanted = [pattern for name in wanted for pattern in candidates(name, vehicle)]

    def look(self) -> None:
        """Subscribe to topics that are new on the bus; call it about once a second."""
        everyone = self._desk.entities()
        for view in topics_of(everyone):
            if view.name in self.topics or view.name in self.refused or not view.givers or not self._wants(view):
                continue
            try:
                kind = message_type(self._desk, view.givers, everyone)
            except CompanionError as error:
                self.refused[view.name] = str(error)
                continue
            self._subscribe(view, kind)

    def _wants(self, view: View) -> bool:
        if self._wanted:
            return any(fnmatch(view.name, pattern) for pattern in self._wanted)
        return not view.hidden and not any(fnmatch(view.name, heavy) for heavy in HEAVY)

    def _subscribe(self, view: View, kind: WireType) -> None:
        qos = [giver.qos for giver in view.givers]
        keeps = all(q.transient_local for q in qos)
        depth = max(1, *(q.depth for q in qos))
        own = Qos(reliable=all(q.reliable for q in qos), transient_local=keeps, depth=depth)
        self.topics[view.name] = kind.name
        self._desk.node.subscribe(view.name, kind, own, self._taker(view.name, kind, offered(own)))

    def _taker(self, name: str, kind: WireType, qos: str) -> Callable[[Arrival], None]:
        clock, put, topic, schema = self._desk.clock, self._recorder.put, name.removeprefix("/"), kind.schema

        def take(arrival: Arrival) -> None:
            now_ns = clock.now_ns()
            sent_ns = arrival.attachment.source_ns if arrival.attachment else now_ns
            put(
                Sample(
                    topic=topic,
                    type=kind.name,
                    schema=schema,
                    payload=arrival.payload,
                    log_ns=now_ns,
                    publish_ns=sent_ns,
                    qos=qos,
                )
            )

        return take
