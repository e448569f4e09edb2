"""Messages as text: YAML blocks as `ros2 topic echo` prints them, CSV, JSON; and parts of them."""

from __future__ import annotations

import csv
import io
import math
import re
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import msgspec
import numpy as np
import yaml

from companion.core.errors import InputError
from companion.runtime.wire import WireType, plain

LONG = 128  # elements or characters; what is longer is cut


@dataclass(frozen=True, slots=True)
class Style:
    """How much of arrays and strings is shown."""

    arrays: bool = True
    full: bool = False


def as_yaml(value: Any, style: Style) -> str:
    """A block that ends with `---`, as ros2's."""
    shown = _shown(value, style)
    if isinstance(shown, dict | list) and shown:
        text: str = yaml.safe_dump(shown, sort_keys=False, allow_unicode=True, width=float("inf"))
    else:
        text = yaml.safe_dump([shown], width=float("inf"), allow_unicode=True)[2:] if shown not in ({}, []) else "{}\n"
    return text + "---"


def as_csv(value: Any, style: Style) -> str:
    """One line of all numbers and strings, in order."""
    out = io.StringIO()
    csv.writer(out, lineterminator="").writerow(list(_leaves(_shown(value, style))))
    return out.getvalue()


def as_json(value: Any, *, arrays: bool = True) -> str:
    """One line; numbers that JSON has not are the strings NaN, Infinity, -Infinity."""
    whole = plain(value) if arrays else _shown(value, Style(arrays=False))
    return msgspec.json.encode(_finite(whole)).decode()


def field_path(text: str, kind: WireType) -> tuple[str | int, ...]:
    """`a.b[3].c` or `a.b.3.c` as a path that the type has; InputError names the valid fields."""
    path: list[str | int] = []
    inside: WireType | None = kind
    is_list = False
    for part in re.findall(r"[^.\[\]]+", text):
        if is_list and part.isdigit():
            path.append(int(part))
            is_list = False
            continue
        if inside is None or is_list:
            raise InputError(
                f"{'.'.join(map(str, path))} has no field {part!r}", field="--field", valid="nothing below"
            )
        found = next((f for f in inside.fields if f.name == part), None)
        if found is None:
            raise InputError(
                f"{inside.name} has no field {part!r}", field="--field", valid=", ".join(inside.field_names)
            )
        path.append(part)
        is_list = found.type.array != "one"
        inside = inside.nested(found.type.base) if found.type.nested else None
    if not path:
        raise InputError("names no field", field="--field", valid=", ".join(kind.field_names))
    return tuple(path)


def part_of(value: Any, path: tuple[str | int, ...]) -> Any:
    """What stands at a path; InputError if an array is shorter."""
    for step in path:
        try:
            value = value[step]
        except IndexError:
            raise InputError(f"no element {step}", field="--field", valid=f"0..{len(value) - 1}") from None
    return value


def _shown(value: Any, style: Style) -> Any:
    if isinstance(value, dict):
        return {key: _shown(inner, style) for key, inner in value.items()}
    if isinstance(value, np.void) and value.dtype.names:
        return {name: _shown(value[name], style) for name in value.dtype.names}
    if isinstance(value, list | np.ndarray):
        return _shown_array(value, style)
    if isinstance(value, str) and len(value) > LONG and not style.full:
        return value[:LONG] + "..."
    return plain(value)


def _shown_array(value: Any, style: Style) -> Any:
    if not style.arrays:
        kind = value.dtype.name if isinstance(value, np.ndarray) and not value.dtype.names else "messages"
        kind = "strings" if len(value) and isinstance(value[0], str) else kind
        return f"<sequence of {kind}, length: {len(value)}>"
    cut = len(value) > LONG and not style.full
    first = value[:LONG] if cut else value
    numbers = isinstance(first, np.ndarray) and not first.dtype.names
    kept = first.tolist() if numbers else [_shown(inner, style) for inner in first]
    return [*kept, "..."] if cut else kept


def _leaves(value: Any) -> Iterator[Any]:
    if isinstance(value, dict | list):
        for inner in value.values() if isinstance(value, dict) else value:
            yield from _leaves(inner)
    else:
        yield value


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _finite(inner) for key, inner in value.items()}
    if isinstance(value, list):
        return [_finite(inner) for inner in value]
    if isinstance(value, float) and not math.isfinite(value):
        return "NaN" if math.isnan(value) else "Infinity" if value > 0 else "-Infinity"
    return value
