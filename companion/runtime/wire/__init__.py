"""The ROS 2 wire without a bus: messages to CDR, type hashes, keys and tokens; bytes and strings only.

`codec_of(topic)` carries our messages; `wire_type(name)` any ROS 2 type as nested dicts;
`companion.runtime.wire.keys` names both as rmw_zenoh does.
"""

from companion.runtime.wire.codecs import Codec, codec_of
from companion.runtime.wire.errors import WireError
from companion.runtime.wire.types import (
    ServiceType,
    WireType,
    bundled_types,
    foreign_type,
    service_type,
    wire_type,
)
from companion.runtime.wire.values import plain

__all__ = [
    "Codec",
    "ServiceType",
    "WireError",
    "WireType",
    "bundled_types",
    "codec_of",
    "foreign_type",
    "plain",
    "service_type",
    "wire_type",
]
