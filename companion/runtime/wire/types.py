"""A ROS 2 type ready for use: identity, schema, and CDR in both directions."""

from __future__ import annotations

from functools import cache, cached_property, lru_cache
from typing import Any

from companion.core.errors import InputError
from companion.runtime.wire.cdr_read import MALFORMED, Order, Reader, ReaderFactory
from companion.runtime.wire.cdr_write import UNFIT, Writer, WriterFactory
from companion.runtime.wire.errors import WireError
from companion.runtime.wire.idl import Field
from companion.runtime.wire.library import Library, library_of
from companion.runtime.wire.type_hash import type_hash
from companion.runtime.wire.values import complete

Payload = bytes | bytearray | memoryview
_HEADER = b"\x00\x01\x00\x00"  # CDR, little endian, no options
_ORDERS: tuple[Order, ...] = (">", "<")  # second byte of the header; others are encodings that ROS 2 does not use


class Types:
    """All types of one library, each made once."""

    def __init__(self, library: Library) -> None:
        self.library = library
        self.writers = WriterFactory(library)
        self.readers = {order: ReaderFactory(library, order) for order in _ORDERS}
        self._made: dict[str, WireType] = {}

    def __getitem__(self, name: str) -> WireType:
        if name not in self._made:
            self.library.references(name)  # an unknown type is found here, not in the first sample
            self._made[name] = WireType(name, self)
        return self._made[name]


class WireType:
    """One message type, or one half of a service. Values are nested dicts.

    Numbers are Python's, sequences of primitives NumPy arrays (on decoding views of the
    payload where its bytes allow), sequences of structs of one regular layout (Point[])
    NumPy struct arrays, all others lists. `values.plain` makes lists of all.
    """

    def __init__(self, name: str, types: Types) -> None:
        self.name = name
        self._types = types
        self._constants = types.library.struct(name).constants

    @property
    def dds_name(self) -> str:
        """The name on the bus: `sensor_msgs::msg::dds_::Imu_`."""
        return dds_name(self.name)

    @cached_property
    def type_hash(self) -> str:
        """`RIHS01_` and 64 hex digits (ROS REP-2016)."""
        return type_hash(self._types.library, self.name)

    @cached_property
    def schema(self) -> str:
        """ros2msg text with all nested types, as an MCAP schema record holds it."""
        return self._types.library.schema(self.name)

    @property
    def constants(self) -> dict[str, Any]:
        """Named constants of the text."""
        return dict(self._constants)

    @property
    def fields(self) -> tuple[Field, ...]:
        """Fields in order, with their types."""
        return self._types.library.struct(self.name).fields

    @property
    def field_names(self) -> tuple[str, ...]:
        """Fields in order."""
        return tuple(f.name for f in self.fields)

    def nested(self, name: str) -> WireType:
        """A type that a field of this one names as its base."""
        return self._types[name]

    def default(self) -> dict[str, Any]:
        """A full value of defaults."""
        return complete(self._types.library, self.name, {})

    def complete(self, value: Any) -> dict[str, Any]:
        """`value` with its missing fields filled in; InputError names a field that is wrong."""
        return complete(self._types.library, self.name, value)

    def encode(self, value: Any) -> bytes:
        """CDR of a mapping or namespace; missing fields get defaults, InputError names a wrong one."""
        out: list[Any] = [_HEADER]
        try:
            self._write(value, out, 0)
        except UNFIT:
            out = [_HEADER]
            try:
                self._write(self.complete(value), out, 0)
            except UNFIT as error:
                raise InputError(f"the value is no {self.name}: {error}") from error
        return b"".join(out)

    def decode(self, payload: Payload) -> dict[str, Any]:
        """The value of a CDR payload of either byte order; WireError if it is malformed.

        Bytes behind the value are ignored: Fast CDR leaves some, as many as its estimate of
        the size was too large.
        """
        view = memoryview(payload).toreadonly().cast("B")
        size = len(view) - 4
        if size < 0 or view[0] or view[1] > 1:
            raise WireError(f"{self.name}: no CDR header in a payload of {len(view)} bytes")
        try:
            value, _ = (self._read if view[1] else self._read_big)(view[4:], 0, size)
        except WireError as error:
            raise WireError(f"{self.name}: {error}") from None
        except MALFORMED as error:
            raise WireError(f"{self.name}: payload of {len(view)} bytes is malformed: {error}") from None
        return value

    @cached_property
    def _write(self) -> Writer:
        return self._types.writers.writer(self.name)

    @cached_property
    def _read(self) -> Reader:
        return self._types.readers["<"].reader(self.name)

    @cached_property
    def _read_big(self) -> Reader:
        return self._types.readers[">"].reader(self.name)


class ServiceType:
    """A service: two message types under one identity."""

    def __init__(self, name: str, types: Types) -> None:
        self.name = name
        self._types = types
        self.request = types[f"{name}_Request"]
        self.response = types[f"{name}_Response"]

    @property
    def dds_name(self) -> str:
        """The name on the bus: `std_srvs::srv::dds_::Trigger_`."""
        return dds_name(self.name)

    @cached_property
    def type_hash(self) -> str:
        """`RIHS01_` and 64 hex digits (ROS REP-2016)."""
        return type_hash(self._types.library, self.name)


def dds_name(name: str) -> str:
    """`package/msg/Name` as it stands in keys and tokens."""
    package, kind, short = name.split("/")
    return f"{package}::{kind}::dds_::{short}_"


def ros_name(dds: str) -> str:
    """Inverse of `dds_name`; WireError if it is none."""
    parts = dds.split("::")
    if len(parts) != 4 or parts[2] != "dds_" or not parts[3].endswith("_"):
        raise WireError(f"{dds!r} is no type name of the bus")
    return f"{parts[0]}/{parts[1]}/{parts[3][:-1]}"


def wire_type(name: str) -> WireType:
    """A bundled type by `package/msg/Name` (or a service's half, `package/srv/Name_Request`)."""
    return _bundled()[name]


@cache
def service_type(name: str) -> ServiceType:
    """A bundled service by `package/srv/Name`."""
    return ServiceType(name, _bundled())


def foreign_type(name: str, schema: str) -> WireType:
    """A type that is not bundled, from its ros2msg schema (an MCAP file's, a peer's)."""
    return Types(library_of(schema, name))[name]


def bundled_types() -> tuple[str, ...]:
    """Full names of all bundled messages and services, sorted."""
    return _bundled().library.bundled


@lru_cache(maxsize=1)
def _bundled() -> Types:
    return Types(Library())
