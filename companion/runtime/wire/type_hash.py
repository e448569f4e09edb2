"""RIHS01, the identity of a type on the bus: SHA-256 of its description as JSON (ROS REP-2016).

Defaults, constants and comments are no part of it: only names and types, in order.
"""

from __future__ import annotations

import hashlib
import json
from typing import Any

from companion.runtime.wire.idl import Field, Struct
from companion.runtime.wire.library import Library

# type_description_interfaces/msg/FieldType: of one element; arrays and sequences add an offset
_TYPE_IDS = {
    **{"int8": 2, "uint8": 3, "char": 3, "int16": 4, "uint16": 5, "int32": 6, "uint32": 7, "int64": 8, "uint64": 9},
    **{"float32": 10, "float64": 11, "bool": 15, "byte": 16, "string": 17},
}
_NESTED, _BOUNDED_STRING = 1, 21
_OFFSETS = {"one": 0, "array": 48, "bounded": 96, "sequence": 144}


def type_hash(library: Library, name: str) -> str:
    """`RIHS01_` and 64 hex digits of a message or service type."""
    described = {
        "type_description": _individual(library.struct(name)),
        "referenced_type_descriptions": [_individual(library.struct(n)) for n in library.references(name)],
    }
    text = json.dumps(described, separators=(", ", ": "))
    return "RIHS01_" + hashlib.sha256(text.encode()).hexdigest()


def _individual(struct: Struct) -> dict[str, Any]:
    fields = [_field(f) for f in struct.fields] or [_filler()]
    return {"type_name": struct.name, "fields": fields}


def _field(field: Field) -> dict[str, Any]:
    kind = field.type
    base = _NESTED if kind.nested else _BOUNDED_STRING if kind.text_capacity else _TYPE_IDS[kind.base]
    return _entry(
        field.name,
        base + _OFFSETS[kind.array],
        capacity=kind.capacity,
        text_capacity=kind.text_capacity,
        nested=kind.base if kind.nested else "",
    )


def _filler() -> dict[str, Any]:
    """An empty struct has one byte, since C has no empty structs."""
    return _entry("structure_needs_at_least_one_member", _TYPE_IDS["uint8"])


def _entry(name: str, type_id: int, *, capacity: int = 0, text_capacity: int = 0, nested: str = "") -> dict[str, Any]:
    kind = {
        "type_id": type_id,
        "capacity": capacity,
        "string_capacity": text_capacity,
        "nested_type_name": nested,
    }
    return {"name": name, "type": kind}
