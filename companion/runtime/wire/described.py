"""Types from descriptions (type_description_interfaces), as ROS 2 nodes tell them."""

from __future__ import annotations

from typing import Any

from companion.runtime.wire.errors import WireError
from companion.runtime.wire.library import Library
from companion.runtime.wire.type_hash import type_hash

_NAMES = {
    1: "", 2: "int8", 3: "uint8", 4: "int16", 5: "uint16", 6: "int32", 7: "uint32", 8: "int64", 9: "uint64",
    10: "float32", 11: "float64", 13: "char", 15: "bool", 16: "byte", 17: "string", 18: "wstring", 21: "string",
    22: "wstring",
}  # fmt: skip
_SHAPES = ("", "[{}]", "[<={}]", "[]")  # one, array, bounded, sequence: 48 ids each
_FILLER = "structure_needs_at_least_one_member"


def described_library(description: dict[str, Any], *, expect_hash: str) -> Library:
    """A library that knows the described type and all it needs; WireError unless it has the hash that was asked for."""
    library = Library()
    main = description["type_description"]
    for one in (main, *description["referenced_type_descriptions"]):
        library.add(one["type_name"], _text(one))
    found = type_hash(library, main["type_name"])
    if found != expect_hash:
        raise WireError(f"what is described as {main['type_name']} has another hash than what is spoken")
    return library


def _text(described: dict[str, Any]) -> str:
    return "".join(_line(field) for field in described["fields"] if field["name"] != _FILLER)


def _line(field: dict[str, Any]) -> str:
    kind = field["type"]
    shape, base = divmod(int(kind["type_id"]), 48)
    if base not in _NAMES or shape >= len(_SHAPES):
        raise WireError(f"type id {kind['type_id']} of field {field['name'][:80]!r} is unknown")
    name = _NAMES[base] or kind["nested_type_name"]
    cap = f"<={kind['string_capacity']}" if base in (21, 22) else ""
    default = field.get("default_value", "") if base != 1 else ""
    return f"{name}{cap}{_SHAPES[shape].format(kind['capacity'])} {field['name']} {default}".rstrip() + "\n"
