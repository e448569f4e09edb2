"""Names on the bus as rmw_zenoh writes them: topic keys, liveliness tokens, attachments.

Source: rmw_zenoh (Jazzy, Kilted); golden tokens and samples of a real node in the tests.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import Literal, NamedTuple, Protocol

import xxhash

from companion.core.errors import InputError
from companion.runtime.wire.errors import WireError
from companion.runtime.wire.qos import Qos, parse_qos, qos_of
from companion.runtime.wire.types import Payload, dds_name, ros_name

__all__ = [
    "Attachment", "Entity", "Key", "Kind", "Qos", "gid_of", "node_token_query", "pack_attachment", "parse_key",
    "parse_qos", "parse_token", "qos_of", "token", "topic_key", "unpack_attachment",
]  # fmt: skip

Kind = Literal["NN", "MP", "MS", "SS", "SC"]  # node, message publisher/subscription, service server/client
KINDS = ("NN", "MP", "MS", "SS", "SC")
_ADMIN = "@ros2_lv"
_ATTACHMENT = struct.Struct("<qqB16s")
_UNSAFE = frozenset("*$#?%{}")  # of key expressions, and `%`, which stands for `/`


class _Identified(Protocol):
    @property
    def dds_name(self) -> str: ...
    @property
    def type_hash(self) -> str: ...


@dataclass(frozen=True, slots=True, kw_only=True)
class Entity:
    """A node or an endpoint of the ROS graph. Names are full: `/drone1/odom`; the type is `package/msg/Name`."""

    kind: Kind
    zid: str  # of the Zenoh session, hex
    node_id: int
    entity_id: int  # of a node: its own id again
    node: str
    namespace: str = "/"
    domain: int = 0
    enclave: str = "/"
    topic: str = ""
    type: str = ""
    type_hash: str = ""
    qos: Qos = Qos()  # noqa: RUF009 (frozen)


class Attachment(NamedTuple):
    """What comes with each sample: who sent it as number what, and when."""

    sequence: int  # from 1
    source_ns: int  # wall clock
    gid: bytes  # 16


class Key(NamedTuple):
    """A topic key taken apart."""

    domain: int
    name: str  # without leading slash
    type: str  # package/msg/Name
    type_hash: str


def topic_key(name: str, kind: _Identified, *, domain: int = 0) -> str:
    """Key of a topic or service: `0/drone1/sensors/imu/sensor_msgs::msg::dds_::Imu_/RIHS01_...`."""
    bare = name.strip("/")
    if not bare or _UNSAFE & set(bare) or "//" in bare:
        raise InputError(f"{name!r} is no topic name", valid="letters, digits, _ and / between")
    return f"{domain}/{bare}/{kind.dds_name}/{kind.type_hash}"


def parse_key(key: str) -> Key:
    """Inverse of `topic_key`; WireError if it is none."""
    parts = key.split("/")
    if len(parts) < 4 or not _is_id(parts[0]):
        raise WireError(f"{key[:120]!r} is no topic key")
    return Key(int(parts[0]), "/".join(parts[1:-2]), ros_name(parts[-2]), parts[-1])


def token(entity: Entity) -> str:
    """The liveliness token that makes the entity known to every ROS graph."""
    head = f"{_ADMIN}/{entity.domain}/{entity.zid}/{entity.node_id}/{entity.entity_id}/{entity.kind}"
    whose = f"{head}/{_mangle(entity.enclave)}/{_mangle(entity.namespace)}/{entity.node}"
    if entity.kind == "NN":
        return whose
    return f"{whose}/{_mangle(entity.topic)}/{dds_name(entity.type)}/{entity.type_hash}/{entity.qos.chunk}"


def parse_token(text: str) -> Entity:
    """Inverse of `token`; WireError if it is none."""
    parts = text.split("/")
    if len(parts) not in (9, 13) or parts[0] != _ADMIN or not all(_is_id(parts[i]) for i in (1, 3, 4)):
        raise WireError(f"{text[:120]!r} is no liveliness token of ROS 2")
    kind = parts[5]
    if kind not in KINDS or (kind == "NN") != (len(parts) == 9):
        raise WireError(f"{text[:120]!r}: {kind!r} is no entity (valid: {', '.join(KINDS)})")
    found: Kind = kind  # type: ignore[assignment]
    node = Entity(
        kind=found,
        domain=int(parts[1]),
        zid=parts[2],
        node_id=int(parts[3]),
        entity_id=int(parts[4]),
        enclave=_demangle(parts[6]),
        namespace=_demangle(parts[7]),
        node=parts[8],
    )
    return node if kind == "NN" else _endpoint(node, parts[9:])


def node_token_query(domain: int = 0) -> str:
    """Key expression of all tokens of a domain."""
    return f"{_ADMIN}/{domain}/**"


def gid_of(token_text: str) -> bytes:
    """The 16-byte id of an endpoint: XXH3-128 of its token, low half first."""
    digest = xxhash.xxh3_128_intdigest(token_text.encode())
    return digest.to_bytes(16, "little")


def pack_attachment(sequence: int, source_ns: int, gid: bytes) -> bytes:
    """The 33 bytes without which ROS drops a sample."""
    return _ATTACHMENT.pack(sequence, source_ns, 16, gid)


def unpack_attachment(data: Payload) -> Attachment:
    """Inverse of `pack_attachment`; WireError if it is none."""
    if len(data) != _ATTACHMENT.size or data[16] != 16:
        raise WireError(f"{len(data)} bytes are no attachment of rmw_zenoh (33 are)")
    sequence, source_ns, _, gid = _ATTACHMENT.unpack(data)
    return Attachment(sequence, source_ns, gid)


def _endpoint(node: Entity, rest: list[str]) -> Entity:
    topic, kind, type_hash, qos = rest
    return Entity(
        kind=node.kind,
        domain=node.domain,
        zid=node.zid,
        node_id=node.node_id,
        entity_id=node.entity_id,
        enclave=node.enclave,
        namespace=node.namespace,
        node=node.node,
        topic=_demangle(topic),
        type=ros_name(kind),
        type_hash=type_hash,
        qos=parse_qos(qos),
    )


def _mangle(name: str) -> str:
    if "%" in name:
        raise InputError(f"{name!r} has a %, which stands for / on the bus")
    return name.replace("/", "%") or "%"


def _demangle(text: str) -> str:
    return text.replace("%", "/")


def _is_id(text: str) -> bool:
    return text.isascii() and text.isdigit() and len(text) < 20
