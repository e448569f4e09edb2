"""Random values of any type, edge cases among them, from a seeded generator."""

import string
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from companion.runtime.wire.idl import INTEGERS, FieldType
from companion.runtime.wire.layout import CODES
from companion.runtime.wire.library import Library

LETTERS = [*string.ascii_letters, " ", "é", "雪", "🚁", "\n", '"']
ODD_FLOATS = (0.0, -0.0, float("nan"), float("inf"), -float("inf"), 1e-45, 1.5)
Fill = Callable[[Any, np.random.Generator], dict[str, Any]]


@pytest.fixture(scope="session")
def random_value() -> Fill:
    """`random_value(wire_type, rng)`: a full value."""
    library = Library()
    return lambda wire, rng: _struct(library, wire.name, rng)


def _struct(library: Library, name: str, rng: np.random.Generator) -> dict[str, Any]:
    return {f.name: _field(library, f.type, rng) for f in library.struct(name).fields}


def _field(library: Library, kind: FieldType, rng: np.random.Generator) -> Any:
    if kind.array == "one":
        return _one(library, kind, rng)
    most = kind.capacity if kind.array == "bounded" else 4
    count = kind.capacity if kind.array == "array" else int(rng.integers(0, most + 1))
    values = [_one(library, kind, rng) for _ in range(count)]
    if kind.nested or kind.base == "string":
        return values
    return np.array(values, CODES[kind.base][1])


def _one(library: Library, kind: FieldType, rng: np.random.Generator) -> Any:
    if kind.nested:
        return _struct(library, kind.base, rng)
    if kind.base == "string":
        text = "".join(LETTERS[i] for i in rng.integers(0, len(LETTERS), rng.integers(0, 9)))
        return text[: kind.text_capacity // 4] if kind.text_capacity else text
    if kind.base == "bool":
        return bool(rng.integers(2))
    if kind.base in INTEGERS:
        low, high = INTEGERS[kind.base]
        odd = (low, high, 0, 1)
        return (
            odd[rng.integers(4)]
            if rng.integers(3) == 0
            else int(rng.integers(low, high, endpoint=True, dtype=CODES[kind.base][1]))
        )
    value = ODD_FLOATS[rng.integers(len(ODD_FLOATS))] if rng.integers(3) == 0 else float(rng.normal()) * 1e3
    return float(np.float32(value)) if kind.base == "float32" else value
