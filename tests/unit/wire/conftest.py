"""Random values of any type, edge cases among them, from a seeded generator."""

import dataclasses
import math
import string
import typing
from collections.abc import Callable
from typing import Any, Literal

import numpy as np
import pytest

from companion.core import messages as m
from companion.runtime.wire.idl import INTEGERS, FieldType
from companion.runtime.wire.layout import CODES
from companion.runtime.wire.library import Library

LETTERS = [*string.ascii_letters, " ", "é", "雪", "🚁", "\n", '"']
ODD_FLOATS = (0.0, -0.0, float("nan"), float("inf"), -float("inf"), 1e-45, 1.5)
STAMP = 1_764_000_000_123_456_789
FIXED = {  # shapes of arrays that are no (3,)
    "covariance": (18, 18), "information": (6, 6), "gradient": (6,), "pose_variance": (6,),
    "next_p_odom": (2, 3), "plan_p_odom": (7, 3), "speed": (7,), "points_body": (9, 3), "miss_dirs_body": (0, 3),
    "points_sensor": (9, 3), "point_age_s": (9,), "miss_dirs_sensor": (4, 3), "miss_age_s": (4,), "pixels": (3, 5),
    "state": (2, 3, 4), "distance_m": (2, 3, 4), "unknown_distance_m": (2, 3, 4), "ground_z_odom": (2, 3),
    "position_odom": (3, 3), "velocity_odom": (3, 3),
}  # fmt: skip
Fill = Callable[[Any, np.random.Generator], dict[str, Any]]


@pytest.fixture(scope="session")
def random_value() -> Fill:
    """`random_value(wire_type, rng)`: a full value."""
    library = Library()
    return lambda wire, rng: _struct(library, wire.name, rng)


@pytest.fixture(scope="session")
def random_message() -> Callable[[type[Any], np.random.Generator], Any]:
    """`random_message(kind, rng)`: one of companion.core.messages, NaN and extremes among its numbers."""
    return _message


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


def _message(kind: type[Any], rng: np.random.Generator) -> Any:
    hints = typing.get_type_hints(kind)
    return m.freeze(kind(**{f.name: _random(kind, f.name, hints[f.name], rng) for f in dataclasses.fields(kind)}))


def _random(kind: type[Any], name: str, hint: Any, rng: np.random.Generator) -> Any:
    if name == "stamp_ns":
        return STAMP + int(rng.integers(0, 10**9))
    if typing.get_origin(hint) is Literal:
        choices = typing.get_args(hint)
        return choices[rng.integers(len(choices))]
    simple = {bool: bool(rng.integers(2)), int: int(rng.integers(-(2**63), 2**63 - 1)), str: "ä" * rng.integers(4)}
    simple |= {float: float(rng.choice([math.nan, -0.0, rng.normal()])), bytes: rng.bytes(rng.integers(9))}
    if hint in simple:
        return simple[hint]
    if dataclasses.is_dataclass(hint):
        return _message(hint, rng)  # type: ignore[arg-type]
    shape = (7, 3) if (kind, name) == (m.Trajectory, "p_odom") else FIXED.get(name, (3,))
    shape = (4,) if name.startswith("q_") else shape
    if kind is m.PoseCorrections and name != "stamps_ns":
        shape = (7, *shape[-1:])
    values = rng.normal(size=shape)
    if values.size:
        values.flat[0] = math.nan
    dtype = {"Array32": np.float32, "Bytes2D": np.uint8}.get("")
    del dtype
    scalar = typing.get_args(typing.get_args(hint)[1])[0] if typing.get_args(hint) else np.float64
    return rng.integers(0, 3, shape).astype(scalar) if issubclass(scalar, np.integer) else values.astype(scalar)
