"""Values to CDR, little endian: one writer is generated per type.

A writer takes complete values of the right kinds, and raises one of `UNFIT` if it meets
anything else: `values.complete` then finds out what is wrong, or fills in what is missing.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import Any

import numpy as np

from companion.runtime.wire.idl import Struct
from companion.runtime.wire.layout import Numbers, Path, Run, Step, Structs, Text, Texts, packers, steps_of
from companion.runtime.wire.library import Library


class UnfitError(Exception):
    """A value that the writer cannot take as it is."""


UNFIT = (UnfitError, struct.error, KeyError, TypeError, ValueError, AttributeError, OverflowError)
Writer = Callable[[Any, list[Any], int], int]
"""(value, buffers to append to, position) to the position behind it."""


class WriterFactory:
    """Makes and keeps the writers of one library."""

    def __init__(self, library: Library) -> None:
        self._library = library
        self._writers: dict[str, Writer] = {}

    def writer(self, name: str) -> Writer:
        """The writer of a type."""
        if name not in self._writers:
            self._writers[name] = self._generate(name)
        return self._writers[name]

    def _generate(self, name: str) -> Writer:
        source = _Source()
        source.open(self._library, self._library.struct(name), ())
        for step in steps_of(self._library, name):
            source.add(step, self.writer(step.base) if isinstance(step, Structs) else None)
        return source.compile()


class _Source:
    """The body of one writer: lines of Python, and the objects that they name."""

    def __init__(self) -> None:
        self._lines = ["def write(m0, out, pos):"]
        self._names: dict[str, Any] = {
            "put_text": _put_text,
            "put_count": _put_count,
            "numbers": _numbers,
            "structs": _structs,
            "listed": _listed,
            "UnfitError": UnfitError,
            "BOOL": {False: False, True: True},
            "PAD": tuple(bytes(n) for n in range(8)),
        }
        self._variables: dict[Path, str] = {(): "m0"}
        self._bools: set[Path] = set()

    def open(self, library: Library, kind: Struct, path: Path) -> None:
        """Name every nested struct, and refuse one with a field too many."""
        me = self._variables[path]
        self._line(f"if len({me}) != {len(kind.fields)}: raise UnfitError")
        for field in kind.fields:
            inner = (*path, field.name)
            if field.type.base == "bool":
                self._bools.add(inner)
            if field.type.nested and field.type.array == "one":
                self._variables[inner] = f"m{len(self._variables)}"
                self._line(f"{self._variables[inner]} = {me}[{field.name!r}]")
                self.open(library, library.struct(field.type.base), inner)

    def add(self, step: Step, inner: Writer | None) -> None:
        """Write one step."""
        if isinstance(step, Run):
            self._run(step)
        elif isinstance(step, Text):
            self._line(f"pos = put_text({self._value(step.path)}, out, pos, {step.bound})")
        elif isinstance(step, Texts):
            self._line(f"s = listed({self._value(step.path)}, {step.count}, {step.bound})")
            if step.count is None:
                self._line("pos = put_count(len(s), out, pos)")
            self._line(f"for x in s: pos = put_text(x, out, pos, {step.text_bound})")
        elif isinstance(step, Numbers):
            dtype = self._name("D", step.dtype)
            self._line(f"a = numbers({self._value(step.path)}, {dtype}, {step.count}, {step.bound})")
            self._array(step.count, step.dtype.itemsize, "a.size")
        else:
            self._structs(step, inner)

    def compile(self) -> Writer:
        """The finished function."""
        self._line("return pos")
        exec("\n".join(self._lines), self._names)
        writer: Writer = self._names["write"]
        return writer

    def _run(self, step: Run) -> None:
        made = packers(step.codes, "<")
        pack = self._name("P", tuple(p.pack for p in made))
        size = self._name("Z", tuple(p.size for p in made))
        values = ", ".join(self._scalar(path) for path in step.paths)
        self._line(f"q = pos & 7; out.append({pack}[q]({values})); pos += {size}[q]")

    def _scalar(self, path: Path) -> str:
        if not path[-1]:
            return "0"  # the one byte of an empty struct
        return f"BOOL[{self._value(path)}]" if path in self._bools else self._value(path)

    def _structs(self, step: Structs, inner: Writer | None) -> None:
        self._line(f"s = {self._value(step.path)}")
        write = self._name("W", inner)
        indent = ""
        if step.dtype is not None:
            first = step.dtype
            while first.names:
                first = first[0]
            self._line("if s.__class__ is ndarray:")
            self._names["ndarray"] = np.ndarray
            plain = self._name("D", _homogeneous(step.dtype))
            self._line(f" a = structs(s, {self._name('D', step.dtype)}, {plain}, {step.count}, {step.bound})")
            self._array(step.count, first.base.itemsize, "len(a)", indent=" ")
            self._line("else:")
            indent = " "
        self._line(f"{indent}s = listed(s, {step.count}, {step.bound})")
        if step.count is None:
            self._line(f"{indent}pos = put_count(len(s), out, pos)")
        self._line(f"{indent}for x in s: pos = {write}(x, out, pos)")

    def _array(self, count: int | None, align: int, length: str, *, indent: str = "") -> None:
        if count is None:
            self._line(f"{indent}pos = put_count({length}, out, pos)")
        if align > 4 or (align > 1 and count is not None):
            self._line(f"{indent}q = -pos & {align - 1}")
            self._line(f"{indent}if q and a.size: out.append(PAD[q]); pos += q")
        self._line(f"{indent}out.append(a); pos += a.nbytes")

    def _value(self, path: Path) -> str:
        return f"{self._variables[path[:-1]]}[{path[-1]!r}]"

    def _name(self, kind: str, value: Any) -> str:
        name = f"{kind}{len(self._names)}"
        self._names[name] = value
        return name

    def _line(self, text: str) -> None:
        self._lines.append(" " + text)


def _homogeneous(dtype: np.dtype[Any]) -> np.dtype[Any] | None:
    """The one scalar type of a struct like Point, so that an (N, 3) array of it may be written as it is."""
    names = dtype.names or ()
    first = dtype[0]
    alike = all(dtype[name] == first for name in names) and len(names) * first.itemsize == dtype.itemsize
    return first if alike and first.kind in "iuf" else None


def _put_text(value: str, out: list[Any], pos: int, bound: int) -> int:
    data = value.encode()
    n = len(data) + 1
    if bound and n > bound + 1:
        raise UnfitError
    q = -pos & 3
    out += (bytes(q), _u32(n), data, b"\0")
    return pos + q + 4 + n


def _put_count(n: int, out: list[Any], pos: int) -> int:
    q = -pos & 3
    if q:
        out.append(bytes(q))
    out.append(_u32(n))
    return pos + q + 4


def _listed(value: Any, count: int | None, bound: int) -> Any:
    if value.__class__ is not list and value.__class__ is not tuple:
        raise UnfitError
    if len(value) != count if count is not None else bound and len(value) > bound:
        raise UnfitError
    return value


def _numbers(value: Any, dtype: np.dtype[Any], count: int | None, bound: int) -> Any:
    if value.__class__ is not np.ndarray:
        if dtype.itemsize != 1 or dtype.kind != "u":
            raise UnfitError
        value = np.frombuffer(value, dtype)  # bytes and the like; a list raises
    if value.dtype != dtype or (value.size != count if count is not None else bound and value.size > bound):
        raise UnfitError
    return np.ascontiguousarray(value)


def _structs(value: Any, dtype: Any, plain: Any, count: int | None, bound: int) -> Any:
    rows = plain is not None and value.dtype == plain and value.ndim == 2 and value.shape[1] == len(dtype.names)
    if value.dtype != dtype and not rows:
        raise UnfitError
    if len(value) != count if count is not None else bound and len(value) > bound:
        raise UnfitError
    return np.ascontiguousarray(value)


_u32 = struct.Struct("<I").pack
