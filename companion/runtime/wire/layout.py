"""How a struct lies in CDR: a flat list of steps that reader and writer are generated from.

XCDR1 (OMG DDS-XTypes 1.3, 7.4.1): each primitive is aligned to its size, counted from the
end of the 4-byte header; a string or sequence has a uint32 count in front, a string a NUL
behind. Neighbouring primitives are merged into one `struct` pack, of which there are eight:
one for each alignment at which it may start.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

from companion.runtime.wire.idl import Struct
from companion.runtime.wire.library import Library

CODES = {  # of one primitive: struct code, NumPy type
    "bool": ("?", "?"),
    "byte": ("B", "u1"),
    "char": ("B", "u1"),
    **{"int8": ("b", "i1"), "uint8": ("B", "u1"), "int16": ("h", "i2"), "uint16": ("H", "u2")},
    **{"int32": ("i", "i4"), "uint32": ("I", "u4"), "int64": ("q", "i8"), "uint64": ("Q", "u8")},
    **{"float32": ("f", "f4"), "float64": ("d", "f8")},
}
Path = tuple[str, ...]
_LARGEST_REGULAR = 1 << 20  # bytes of one element that a NumPy struct is made for


@dataclass(frozen=True, slots=True)
class Run:
    """Neighbouring primitives."""

    paths: tuple[Path, ...]
    codes: str


@dataclass(frozen=True, slots=True)
class Numbers:
    """Primitives in an array (`count`) or a sequence (`count` None, at most `bound` if not 0)."""

    path: Path
    dtype: np.dtype[Any]
    count: int | None
    bound: int


@dataclass(frozen=True, slots=True)
class Text:
    """One string."""

    path: Path
    bound: int


@dataclass(frozen=True, slots=True)
class Texts:
    """Strings in an array or a sequence."""

    path: Path
    count: int | None
    bound: int
    text_bound: int


@dataclass(frozen=True, slots=True)
class Structs:
    """Structs in an array or a sequence; with `dtype` if all of them have one regular layout."""

    path: Path
    base: str
    count: int | None
    bound: int
    dtype: np.dtype[Any] | None
    least_bytes: int


Step = Run | Numbers | Text | Texts | Structs


def steps_of(library: Library, name: str) -> list[Step]:
    """The steps of a type in the order of the wire; nested single structs are flattened."""
    library.references(name)  # raises if a type contains itself
    flat = list(_flatten(library, library.struct(name), ()))
    merged: list[Step] = []
    for step in flat:
        if isinstance(step, Run) and merged and isinstance(merged[-1], Run):
            merged[-1] = Run(merged[-1].paths + step.paths, merged[-1].codes + step.codes)
        else:
            merged.append(step)
    return merged


@cache
def packers(codes: str, order: str) -> tuple[struct.Struct, ...]:
    """One `struct.Struct` per start position modulo 8, with the padding inside."""
    made = []
    for start in range(8):
        layout, at = "", start
        for code in codes:
            size = struct.calcsize("<" + code)
            layout += "x" * (-at % size) + code
            at += -at % size + size
        made.append(struct.Struct(order + layout))
    return tuple(made)


def _flatten(library: Library, kind: Struct, prefix: Path) -> Any:
    if not kind.fields:  # an empty struct is one byte on the wire
        yield Run(((*prefix, ""),), "B")
    for field in kind.fields:
        t, path = field.type, (*prefix, field.name)
        if t.array == "one":
            if t.nested:
                yield from _flatten(library, library.struct(t.base), path)
            else:
                yield Text(path, t.text_capacity) if t.base == "string" else Run((path,), CODES[t.base][0])
            continue
        count = t.capacity if t.array == "array" else None
        if t.nested:
            dtype = regular_dtype(library, t.base)
            yield Structs(path, t.base, count, t.capacity, dtype, least_bytes(library, t.base))
        elif t.base == "string":
            yield Texts(path, count, t.capacity, t.text_capacity)
        else:
            yield Numbers(path, np.dtype(CODES[t.base][1]), count, t.capacity)


def least_bytes(library: Library, name: str) -> int:
    """The fewest bytes that a value of the type takes: what a count can be checked against."""
    total = 0
    for field in library.struct(name).fields:
        t = field.type
        if t.array in ("sequence", "bounded"):
            total += 4
            continue
        one = least_bytes(library, t.base) if t.nested else 4 if t.base == "string" else _size(t.base)
        total += one * (t.capacity if t.array == "array" else 1)
    return total or 1


def regular_dtype(library: Library, name: str) -> np.dtype[Any] | None:
    """A NumPy struct of the same layout as every element of a CDR sequence of `name`, if there is one.

    There is if all is of fixed size, no padding depends on where an element starts, and none is
    bool (a byte 2 is no NumPy bool).
    """
    leaves = _leaves(library, name)
    if not leaves:
        return None
    widest = max(size for size, _ in leaves)
    if leaves[0][0] != widest or sum(size * count for size, count in leaves) > _LARGEST_REGULAR:
        return None
    dtype, _, end = _packed(library, name, 0)
    return None if end % widest else dtype


def _leaves(library: Library, name: str) -> list[tuple[int, int]] | None:
    found: list[tuple[int, int]] = []
    for field in library.struct(name).fields:
        t = field.type
        if t.array in ("sequence", "bounded") or t.base in ("string", "bool"):
            return None
        if t.nested:
            if t.array != "one" or not (inner := _leaves(library, t.base)):
                return None
            found += inner
        else:
            found.append((_size(t.base), t.capacity or 1))
    return found


def _packed(library: Library, name: str, at: int) -> tuple[np.dtype[Any], int, int]:
    """The dtype of a struct whose first byte is at `at` or after its padding; its start and end."""
    names: list[str] = []
    formats: list[np.dtype[Any]] = []
    starts: list[int] = []
    for field in library.struct(name).fields:
        t = field.type
        if t.nested:
            dtype, start, at = _packed(library, t.base, at)
        else:
            size = _size(t.base)
            start = at + -at % size
            one = np.dtype(CODES[t.base][1])
            dtype = np.dtype((one, (t.capacity,))) if t.array == "array" else one
            at = start + size * (t.capacity or 1)
        names.append(field.name)
        formats.append(dtype)
        starts.append(start)
    offsets = [start - starts[0] for start in starts]
    layout: Any = {"names": names, "formats": formats, "offsets": offsets, "itemsize": at - starts[0]}
    return np.dtype(layout), starts[0], at


def _size(base: str) -> int:
    return struct.calcsize("<" + CODES[base][0])
