"""Values of any type as nested dicts: filling in, checking, and making them plain."""

from __future__ import annotations

import difflib
from collections.abc import Mapping, Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np

from companion.core.errors import InputError
from companion.runtime.wire.idl import INTEGERS, Field, FieldType
from companion.runtime.wire.layout import CODES, regular_dtype
from companion.runtime.wire.library import Library


def complete(library: Library, name: str, value: Any, *, where: str = "") -> dict[str, Any]:
    """A full value of the type from one with fields missing; InputError names the field that is wrong.

    `value` is a mapping or a namespace. Missing fields get the default of the text, else zero.
    """
    given = vars(value) if isinstance(value, SimpleNamespace) else value
    if isinstance(given, np.void) and given.dtype.names:
        given = {n: given[n] for n in given.dtype.names}
    fields = library.struct(name).fields
    known = [f.name for f in fields]
    if not isinstance(given, Mapping):
        raise InputError(f"{_short(value)} is no {name}", field=where, valid=f"a mapping with {', '.join(known)}")
    for key in given:
        if key not in known:
            near = difflib.get_close_matches(str(key), known, n=1)
            hint = f"; meant {near[0]}?" if near else ""
            raise InputError(f"{name} has no such field{hint}", field=_join(where, key), valid=", ".join(known))
    return {
        f.name: _value(library, f.type, given[f.name], _join(where, f.name))
        if f.name in given
        else _default(library, f)
        for f in fields
    }


def plain(value: Any) -> Any:
    """The value with lists for arrays: for printing and JSON."""
    if isinstance(value, dict):
        return {key: plain(inner) for key, inner in value.items()}
    if isinstance(value, list):
        return [plain(inner) for inner in value]
    if isinstance(value, np.void) and value.dtype.names:
        return {name: plain(value[name]) for name in value.dtype.names}
    if isinstance(value, np.ndarray) and value.dtype.names:
        return [plain(element) for element in value]
    return value.tolist() if isinstance(value, np.ndarray | np.generic) else value


def _default(library: Library, field: Field) -> Any:
    kind = field.type
    if field.default is not None:
        return _value(library, kind, field.default, field.name)
    count = kind.capacity if kind.array == "array" else 0
    if kind.array == "one":
        return complete(library, kind.base, {}) if kind.nested else "" if kind.base == "string" else _zero(kind.base)
    if kind.nested:
        return [complete(library, kind.base, {}) for _ in range(count)]
    return [""] * count if kind.base == "string" else np.zeros(count, CODES[kind.base][1])


def _zero(base: str) -> Any:
    return False if base == "bool" else 0 if base in INTEGERS else 0.0


def _value(library: Library, kind: FieldType, value: Any, where: str) -> Any:
    if kind.array == "one":
        return _one(library, kind, value, where)
    if not kind.nested and kind.base != "string":
        array = _numbers(kind.base, value, where)
        _check_length(kind, array.size, where)
        return array
    if isinstance(value, np.ndarray) and kind.nested:
        return _struct_array(library, kind, value, where)
    if isinstance(value, str | bytes | Mapping) or not isinstance(value, Sequence):
        raise InputError(f"{_short(value)} is no list of {kind.base}", field=where)
    _check_length(kind, len(value), where)
    return [_one(library, kind, element, f"{where}[{i}]") for i, element in enumerate(value)]


def _struct_array(library: Library, kind: FieldType, value: Any, where: str) -> Any:
    dtype = regular_dtype(library, kind.base)
    _check_length(kind, len(value), where)
    if dtype is None:
        return [_one(library, kind, element, f"{where}[{i}]") for i, element in enumerate(value)]
    if value.dtype == dtype:
        return value
    names = dtype.names or ()
    if value.dtype.names is None and value.ndim == 2 and value.shape[1] == len(names):
        rows = [dict(zip(names, row, strict=True)) for row in value.tolist()]
        return [_one(library, kind, row, f"{where}[{i}]") for i, row in enumerate(rows)]
    shape = f"{value.dtype} {value.shape}"
    raise InputError(f"an array {shape} is no list of {kind.base}", field=where, valid=f"(N, {len(names)})")


def _one(library: Library, kind: FieldType, value: Any, where: str) -> Any:
    if kind.nested:
        return complete(library, kind.base, value, where=where)
    if kind.base == "string":
        return _text(kind, value, where)
    if isinstance(value, np.generic):
        value = value.item()
    if kind.base == "bool":
        if value is True or value is False:
            return value
        raise InputError(f"{_short(value)} is no bool", field=where, valid="true, false")
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise InputError(f"{_short(value)} is no {kind.base}", field=where)
    return _number(kind.base, value, where)


def _text(kind: FieldType, value: Any, where: str) -> str:
    if not isinstance(value, str):
        raise InputError(f"{_short(value)} is no string", field=where)
    try:
        size = len(value.encode())
    except UnicodeEncodeError:
        raise InputError("the string is no valid Unicode", field=where) from None
    if kind.text_capacity and size > kind.text_capacity:
        raise InputError(f"{size} bytes, {kind.text_capacity} is the most", field=where)
    return value


def _number(base: str, value: int | float, where: str) -> int | float:
    if base in INTEGERS:
        low, high = INTEGERS[base]
        if not isinstance(value, int) or not low <= value <= high:
            raise InputError(f"{_short(value)} is no {base}", field=where, valid=f"{low}..{high}")
        return value
    number = float(value) if not isinstance(value, int) or abs(value) < 2**1023 else float("nan")
    finite_but_huge = base == "float32" and abs(number) > _FLOAT32_MAX and number not in (np.inf, -np.inf)
    if finite_but_huge or (number != number and isinstance(value, int)):
        raise InputError(f"{_short(value)} does not fit into {base}", field=where)
    return number


def _numbers(base: str, value: Any, where: str) -> Any:
    dtype = np.dtype(CODES[base][1])
    if isinstance(value, bytes | bytearray | memoryview):
        value = np.frombuffer(value, "u1")
    if isinstance(value, np.ndarray) and value.dtype == dtype:
        return value
    if isinstance(value, str) or not isinstance(value, Sequence | np.ndarray):
        raise InputError(f"{_short(value)} is no list of {base}", field=where)
    kind = FieldType(base)
    listed = value.ravel().tolist() if isinstance(value, np.ndarray) else value
    return np.array([_one(_NONE, kind, v, f"{where}[{i}]") for i, v in enumerate(listed)], dtype)


def _check_length(kind: FieldType, length: int, where: str) -> None:
    if kind.array == "array" and length != kind.capacity:
        raise InputError(f"{length} elements, {kind.capacity} wanted", field=where)
    if kind.array == "bounded" and length > kind.capacity:
        raise InputError(f"{length} elements, {kind.capacity} is the most", field=where)


def _join(where: str, key: Any) -> str:
    return f"{where}.{key}" if where else str(key)


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "..."


_FLOAT32_MAX = 3.4028235677973366e38  # what still rounds to a finite float32
_NONE = Library()
