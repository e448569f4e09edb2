"""CDR to values: one reader is generated per type and byte order.

A reader never trusts a count: it is checked against the bytes that are there before
anything is made of it. It raises `WireError` or what `MALFORMED` names; nothing else.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import Any, Literal

import numpy as np

from companion.runtime.wire.errors import WireError
from companion.runtime.wire.idl import Struct
from companion.runtime.wire.layout import Numbers, Path, Run, Step, Structs, Text, Texts, packers, steps_of
from companion.runtime.wire.library import Library

MALFORMED = (struct.error, ValueError, IndexError, OverflowError)
Order = Literal["<", ">"]
Reader = Callable[[memoryview, int, int], tuple[dict[str, Any], int]]
"""(bytes behind the header, position, end) to (value, position behind it)."""


class ReaderFactory:
    """Makes and keeps the readers of one library for one byte order (`<` or `>`)."""

    def __init__(self, library: Library, order: Order) -> None:
        self._library, self._order = library, order
        self._readers: dict[str, Reader] = {}

    def reader(self, name: str) -> Reader:
        """The reader of a type."""
        if name not in self._readers:
            self._readers[name] = self._generate(name)
        return self._readers[name]

    def _generate(self, name: str) -> Reader:
        source = _Source(self._order)
        for step in steps_of(self._library, name):
            inner = self.reader(step.base) if isinstance(step, Structs) and step.dtype is None else None
            source.add(step, inner)
        return source.compile(_tree(self._library, self._library.struct(name), ()))


class _Source:
    """The body of one reader: lines of Python, and the objects that they name."""

    def __init__(self, order: Order) -> None:
        self._order = order
        self._lines = ["def read(b, pos, end):"]
        self._names: dict[str, Any] = {"FB": np.frombuffer, **_helpers(order)}
        self._variables: dict[Path, str] = {}

    def add(self, step: Step, inner: Reader | None) -> None:
        """Read one step into variables."""
        if isinstance(step, Run):
            self._run(step)
        elif isinstance(step, Text):
            self._line(f"{self._variable(step.path)}, pos = text(b, pos, end, {step.bound})")
        elif isinstance(step, Texts):
            self._count(step.count, step.bound, 4)
            self._line(f"{self._variable(step.path)}, pos = texts(b, pos, end, n, {step.text_bound})")
        elif isinstance(step, Numbers):
            self._numbers(step)
        else:
            self._structs(step, inner)

    def compile(self, tree: str) -> Reader:
        """The finished function; `tree` is the value as an expression of paths."""
        for path, variable in self._variables.items():
            tree = tree.replace(_mark(path), variable)
        self._line(f"return {tree}, pos")
        exec("\n".join(self._lines), self._names)
        reader: Reader = self._names["read"]
        return reader

    def _run(self, step: Run) -> None:
        made = packers(step.codes, self._order)
        unpack = self._name("U", tuple(p.unpack_from for p in made))
        size = self._name("Z", tuple(p.size for p in made))
        targets = ", ".join(self._variable(path) for path in step.paths)
        self._line(f"q = pos & 7; {targets}, = {unpack}[q](b, pos); pos += {size}[q]")

    def _numbers(self, step: Numbers) -> None:
        size = step.dtype.itemsize
        wire = np.dtype("u1") if step.dtype.kind == "b" else step.dtype.newbyteorder(self._order)
        self._count(step.count, step.bound, size)
        self._array(self._variable(step.path), wire, size, size)
        if step.dtype.kind == "b":
            self._line(f"{self._variables[step.path]} = {self._variables[step.path]} != 0")

    def _array(self, target: str, wire: np.dtype[Any], item: int, align: int) -> None:
        dtype = self._name("D", wire)
        if align > 4:  # an empty sequence has no padding behind its count
            self._line(f"if n: pos += -pos & {align - 1}")
        elif align > 1:
            self._line(f"pos += -pos & {align - 1}")
        self._line(f"{target} = FB(b, {dtype}, n, pos) if n else {self._name('E', np.empty(0, wire))}")
        self._line(f"pos += n * {item}")
        if not wire.isnative and wire.itemsize > 1:
            self._line(f"{target} = {target}.astype({self._name('D', wire.newbyteorder('='))})")
        elif align == 8:  # never aligned in memory, since the header has 4 bytes
            self._line(f"{target} = {target}.copy()")
        elif align > 1:
            self._line(f"if not {target}.flags.aligned: {target} = {target}.copy()")

    def _structs(self, step: Structs, inner: Reader | None) -> None:
        self._count(step.count, step.bound, step.least_bytes)
        target = self._variable(step.path)
        if step.dtype is not None:
            first = step.dtype
            while first.names:
                first = first[0]
            wire = step.dtype.newbyteorder(self._order)
            self._array(target, wire, step.dtype.itemsize, first.base.itemsize)
            return
        read = self._name("R", inner)
        self._line(f"{target} = []; put = {target}.append")
        self._line("for _ in range(n):")
        self._line(f" x, pos = {read}(b, pos, end); put(x)")

    def _count(self, count: int | None, bound: int, least: int) -> None:
        self._line(f"n, pos = count(b, pos, end, {bound}, {least})" if count is None else f"n = {count}")

    def _variable(self, path: Path) -> str:
        return self._variables.setdefault(path, f"v{len(self._variables)}")

    def _name(self, kind: str, value: Any) -> str:
        name = f"{kind}{len(self._names)}"
        self._names[name] = value
        return name

    def _line(self, text: str) -> None:
        self._lines.append(" " + text)


def _tree(library: Library, kind: Struct, prefix: Path) -> str:
    parts = []
    for field in kind.fields:
        path = (*prefix, field.name)
        single = field.type.nested and field.type.array == "one"
        value = _tree(library, library.struct(field.type.base), path) if single else _mark(path)
        parts.append(f"{field.name!r}: {value}")
    return "{" + ", ".join(parts) + "}"


def _mark(path: Path) -> str:
    return "<" + "/".join(path) + ">"


def _helpers(order: str) -> dict[str, Any]:
    """What the generated lines call, for one byte order."""
    u32 = struct.Struct(order + "I").unpack_from

    def count(b: memoryview, pos: int, end: int, bound: int, least: int) -> tuple[int, int]:
        pos += -pos & 3
        (n,) = u32(b, pos)
        pos += 4
        if n * least > end - pos:
            raise WireError(f"{n} elements announced, {end - pos} bytes left")
        if bound and n > bound:
            raise WireError(f"{n} elements where {bound} is the most")
        return n, pos

    def text(b: memoryview, pos: int, end: int, bound: int) -> tuple[str, int]:
        pos += -pos & 3
        (n,) = u32(b, pos)
        pos += 4
        stop = pos + n
        if n == 0:  # some writers leave out the NUL of an empty string
            return "", pos
        if stop > end or b[stop - 1]:
            raise WireError(f"a string of {n} bytes does not end")
        value = str(b[pos : stop - 1], "utf-8")
        if bound and n - 1 > bound:
            raise WireError(f"a string of {n - 1} bytes where {bound} is the most")
        return value, stop

    def texts(b: memoryview, pos: int, end: int, n: int, bound: int) -> tuple[list[str], int]:
        found = []
        for _ in range(n):
            one, pos = text(b, pos, end, bound)
            found.append(one)
        return found, pos

    return {"count": count, "text": text, "texts": texts}
