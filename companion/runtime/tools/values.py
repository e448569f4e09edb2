"""Values that a user types, YAML or JSON, as values of a type; `now` and `auto` stand for the time."""

from __future__ import annotations

from typing import Any

import yaml

from companion.core.errors import InputError
from companion.runtime.wire import WireType
from companion.runtime.wire.parts import time_of

HEADER, TIME = "std_msgs/msg/Header", "builtin_interfaces/msg/Time"


def parse_values(text: str, *, what: str = "VALUES") -> dict[str, Any]:
    """A mapping; InputError if the text is none."""
    try:
        value = yaml.safe_load(text) if text.strip() else {}
    except yaml.YAMLError as error:
        raise InputError(f"no YAML: {str(error).splitlines()[0]}", field=what, valid="'{field: value}'") from None
    if not isinstance(value, dict):
        raise InputError(f"{text[:60]!r} is no mapping", field=what, valid="'{field: value}'")
    return value


def stamped(kind: WireType, value: Any, now_ns: int) -> Any:
    """The value with the time where `auto` stands for a header, or `now` for a time, and numbers for numerals.

    YAML takes 1e-3 for a word (it wants 1.0e-3): where the type wants a number it is one.
    """
    if kind.name == HEADER and value == "auto":
        return {"stamp": time_of(now_ns)}
    if kind.name == TIME and value == "now":
        return time_of(now_ns)
    if not isinstance(value, dict):
        return value
    fields = {f.name: f.type for f in kind.fields}
    filled = dict(value)
    for name, given in value.items():
        if name not in fields:
            continue  # the type itself says which there are
        base = fields[name].base
        if fields[name].nested:
            inside = kind.nested(base)
            many = fields[name].array != "one" and isinstance(given, list)
            filled[name] = [stamped(inside, v, now_ns) for v in given] if many else stamped(inside, given, now_ns)
        elif base.startswith("float"):
            filled[name] = [_number(v) for v in given] if isinstance(given, list) else _number(given)
    return filled


def short_name(text: str, kind: str) -> str:
    """`std_msgs/String` or `std_msgs/msg/String` as the latter; `kind` is msg or srv."""
    parts = text.strip("/").split("/")
    return f"{parts[0]}/{kind}/{parts[1]}" if len(parts) == 2 else text


def _number(value: Any) -> Any:
    try:
        return float(value) if isinstance(value, str) else value
    except ValueError:
        return value  # refused by name, later
