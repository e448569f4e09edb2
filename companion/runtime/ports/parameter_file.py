"""Parameter files: written as QGroundControl writes them; read in that form and in MAVProxy's.

QGroundControl's has five columns between tabs, MAVProxy's the two of NAME VALUE:

    1	1	MPC_XY_P	0.65	9        # vehicle, component, name, value, MAV_PARAM_TYPE
    MPC_XY_P         0.650000

Source: docs.qgroundcontrol.com, "Parameters File Format"; MAVProxy's mav.parm.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

from companion.core.errors import InputError
from companion.runtime.ports.parameters import Value, read_value, same, shown, unknown

INT32: Final = 6  # MAV_PARAM_TYPE
REAL32: Final = 9
_FORMS: Final = "lines of `vehicle component NAME VALUE type` or `NAME VALUE`"


@dataclass(frozen=True, slots=True)
class Entry:
    """One line of a file; the vehicle's type decides how the text is read."""

    line: int
    name: str
    text: str


@dataclass(frozen=True, slots=True)
class Difference:
    """A parameter that has one value in the vehicle and another in the file."""

    name: str
    vehicle: Value
    file: Value


def write_text(values: Mapping[str, Value], *, system: int = 1, component: int = 1) -> str:
    """The text of a file; the same values give the same bytes."""
    lines = ["# Parameters by companion param save", "# Vehicle-Id Component-Id Name Value Type"]
    for name, value in sorted(values.items()):
        kind = INT32 if isinstance(value, int) else REAL32
        lines.append(f"{system}\t{component}\t{name}\t{shown(value)}\t{kind}")
    return "\n".join(lines) + "\n"


def read_entries(text: str, *, file: str) -> list[Entry]:
    """The lines of a file; raises InputError for a line of no known form and for a name that comes twice."""
    entries: dict[str, Entry] = {}
    for number, line in enumerate(text.splitlines(), 1):
        words = line.split("#")[0].split()
        if not words:
            continue
        if len(words) not in (2, 5):
            raise InputError(f"{line.strip()!r} is no parameter", file=file, line=number, valid=_FORMS)
        name, value = words if len(words) == 2 else words[2:4]
        if name in entries:
            raise InputError(f"stands in line {entries[name].line} already", file=file, line=number, field=name)
        entries[name] = Entry(number, name, value)
    if not entries:
        raise InputError("holds no parameters", file=file, valid=_FORMS)
    return list(entries.values())


def differences(entries: list[Entry], values: Mapping[str, Value], *, file: str) -> list[Difference]:
    """What differs, in the order of the file; raises InputError for names and values that the vehicle cannot have."""
    found = []
    for e in entries:
        if e.name not in values:
            raise unknown(e.name, values, file=file, line=e.line)
        wanted = _value(e, values[e.name], file)
        if not same(wanted, values[e.name]):
            found.append(Difference(e.name, values[e.name], wanted))
    return found


def _value(entry: Entry, like: Value, file: str) -> Value:
    """MAVProxy writes integers as 15.000000."""
    whole = entry.text.rstrip("0").removesuffix(".") if isinstance(like, int) and "." in entry.text else entry.text
    return read_value(whole, like, entry.name, file=file, line=entry.line)
