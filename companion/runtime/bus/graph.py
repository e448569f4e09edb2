"""Our nodes as the ROS 2 graph sees them: liveliness tokens, publishers, subscriptions, services.

    with open_session("first") as session, Graph(session) as graph:
        node = graph.node("camera_driver", namespace="/drone1")
        publisher = node.publisher("/drone1/image", wire_type("sensor_msgs/msg/Image"), SENSOR)
        publisher.put(payload, stamp_ns)

Everything stays declared until the graph is closed, or the endpoint.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from types import TracebackType
from typing import Any, NamedTuple, Protocol

import zenoh
from zenoh import ext

from companion.runtime.wire.errors import WireError
from companion.runtime.wire.keys import (
    Attachment,
    Entity,
    Kind,
    Qos,
    gid_of,
    pack_attachment,
    token,
    topic_key,
    unpack_attachment,
)

_TIMEOUT = b"Timeout"  # the error that the session or a router writes in the place of a server
Received = Callable[["Arrival"], None]


class Identity(Protocol):
    """What names a type on the bus: a `WireType`, a `ServiceType`, or the names alone."""

    @property
    def name(self) -> str:
        """`package/msg/Name`."""
        ...

    @property
    def dds_name(self) -> str:
        """As in keys: `package::msg::dds_::Name_`."""
        ...

    @property
    def type_hash(self) -> str:
        """`RIHS01_` and 64 hex digits."""
        ...


class Arrival(NamedTuple):
    """One sample as it came; `attachment` is None if the sender is no ROS 2 node."""

    payload: bytes
    attachment: Attachment | None


class Urgency(NamedTuple):
    """How Zenoh treats what is put; nothing ever blocks the sender."""

    priority: zenoh.Priority = zenoh.Priority.DATA
    express: bool = False  # not batched with others


class Graph:
    """All entities of one session; ids count up from 0, as rmw_zenoh's do."""

    def __init__(self, session: zenoh.Session, *, domain: int = 0) -> None:
        self.session, self.domain = session, domain
        self._ids = itertools.count()
        self._open: list[Any] = []

    def node(self, name: str, *, namespace: str = "/") -> GraphNode:
        """Declare a node."""
        return GraphNode(self, name, namespace)

    def next_id(self) -> int:
        """For a new entity."""
        return next(self._ids)

    def keep(self, declared: Any) -> None:
        """Undeclare it when the graph closes."""
        self._open.append(declared)

    def __enter__(self) -> Graph:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        while self._open:
            self._open.pop().undeclare()


class GraphNode:
    """A node, and what it declares."""

    def __init__(self, graph: Graph, name: str, namespace: str) -> None:
        self.name, self.namespace = name, namespace
        self._graph = graph
        self._id = graph.next_id()
        self._declare("NN", self._id)

    def publisher(self, name: str, kind: Identity, qos: Qos, urgency: Urgency | None = None) -> Publisher:
        """A publisher on the full topic name; transient local ones keep `qos.depth` samples for late joiners."""
        gid = self._declare("MP", topic=name, kind=kind, qos=qos)
        how = urgency or Urgency()
        options: dict[str, Any] = {
            "congestion_control": zenoh.CongestionControl.DROP,
            "priority": how.priority,
            "express": how.express,
        }
        declared: Any
        session, key = self._graph.session, topic_key(name, kind, domain=self._graph.domain)
        if qos.transient_local:
            cache = ext.CacheConfig(max_samples=qos.depth)
            declared = ext.declare_advanced_publisher(session, key, cache=cache, publisher_detection=True, **options)
        else:
            declared = session.declare_publisher(key, **options)
        self._graph.keep(declared)
        return Publisher(declared, gid, keeps=qos.transient_local)

    def subscribe(self, name: str, kind: Identity, qos: Qos, received: Received) -> None:
        """Call `received` for every sample, on Zenoh's thread: it must only put the sample away."""
        self._declare("MS", topic=name, kind=kind, qos=qos)
        session, key = self._graph.session, topic_key(name, kind, domain=self._graph.domain)

        def take(sample: zenoh.Sample) -> None:
            received(arrival(sample))

        declared: Any
        if qos.transient_local:
            history = ext.HistoryConfig(detect_late_publishers=True, max_samples=qos.depth)
            declared = ext.declare_advanced_subscriber(session, key, take, history=history)
        else:
            declared = session.declare_subscriber(key, take)
        self._graph.keep(declared)

    def serve(self, name: str, kind: Identity, answer: Callable[[bytes], bytes]) -> None:
        """Answer requests (CDR in, CDR out) on Zenoh's thread; an answer must be quick and raise only WireError."""
        qos = Qos(depth=10)
        gid = self._declare("SS", topic=name, kind=kind, qos=qos)

        def reply(query: zenoh.Query) -> None:
            request = query.payload.to_bytes() if query.payload is not None else b""
            asked = attachment_of(query.attachment)
            try:
                response = answer(request)
            except WireError as error:
                query.reply_err(str(error).encode())
                return
            number, stamp_ns = (asked.sequence, asked.source_ns) if asked else (0, 0)
            query.reply(str(query.key_expr), response, attachment=pack_attachment(number, stamp_ns, gid))

        key = topic_key(name, kind, domain=self._graph.domain)
        self._graph.keep(self._graph.session.declare_queryable(key, reply, complete=True))

    def call(self, name: str, kind: Identity, request: bytes, *, stamp_ns: int, timeout_s: float) -> bytes | None:
        """Ask a service; None if nobody answers in time. Raises WireError for an answer that is an error."""
        gid = self._declare("SC", topic=name, kind=kind, qos=Qos(depth=10))
        replies = self._graph.session.get(
            topic_key(name, kind, domain=self._graph.domain),
            payload=request,
            attachment=pack_attachment(1, stamp_ns, gid),
            target=zenoh.QueryTarget.ALL_COMPLETE,
            timeout=timeout_s,
        )
        for reply in replies:
            if reply.ok is not None:
                return reply.ok.payload.to_bytes()
            if reply.err is not None and (said := reply.err.payload.to_bytes()) != _TIMEOUT:
                raise WireError(f"{name}: {said.decode(errors='replace')}")
        return None

    def _declare(
        self,
        entity_kind: Kind,
        entity_id: int | None = None,
        *,
        topic: str = "",
        kind: Identity | None = None,
        qos: Qos | None = None,
    ) -> bytes:
        """Declare the token of an entity; returns the gid that goes with it."""
        text = token(
            Entity(
                kind=entity_kind,
                zid=str(self._graph.session.zid()),
                node_id=self._id,
                entity_id=self._graph.next_id() if entity_id is None else entity_id,
                node=self.name,
                namespace=self.namespace,
                domain=self._graph.domain,
                topic=topic,
                type=kind.name if kind else "",
                type_hash=kind.type_hash if kind else "",
                qos=qos or Qos(),
            )
        )
        self._graph.keep(self._graph.session.liveliness().declare_token(text))
        return gid_of(text)


class Publisher:
    """Puts CDR payloads; numbers them from 1."""

    def __init__(self, declared: Any, gid: bytes, *, keeps: bool) -> None:
        self._declared, self._gid, self._keeps = declared, gid, keeps
        self.sequence = 0

    @property
    def wanted(self) -> bool:
        """Whether anyone listens, or may join later and want what was said."""
        return self._keeps or self.matched

    @property
    def matched(self) -> bool:
        """Whether anyone listens: what is put before that is lost."""
        return bool(self._declared.matching_status.matching)

    def put(self, payload: bytes, stamp_ns: int) -> None:
        """Send; drops rather than waits."""
        self.sequence += 1
        self._declared.put(payload, attachment=pack_attachment(self.sequence, stamp_ns, self._gid))


def arrival(sample: zenoh.Sample) -> Arrival:
    """A sample's bytes and who sent it."""
    return Arrival(sample.payload.to_bytes(), attachment_of(sample.attachment))


def attachment_of(data: zenoh.ZBytes | None) -> Attachment | None:
    """None for what is none: a stranger's sample is no reason to stop."""
    if data is None:
        return None
    try:
        return unpack_attachment(data.to_bytes())
    except WireError:
        return None
