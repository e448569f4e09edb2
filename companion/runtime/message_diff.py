"""Two messages field by field: what differs, and by how much."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields, is_dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from companion.runtime.codec import encode


@dataclass(frozen=True, slots=True)
class FieldDifference:
    """One field that differs; `largest` is the largest |difference|, NaN where there is none in numbers."""

    name: str
    logged: str
    replayed: str
    largest: float

    def __str__(self) -> str:
        amount = "" if math.isnan(self.largest) else f" (|difference| up to {self.largest:.3g})"
        return f"{self.name}: {self.logged} -> {self.replayed}{amount}"


@dataclass(slots=True)
class TopicDifferences:
    """All pairs of messages of one topic."""

    compared: int = 0
    differing: int = 0
    only_logged: int = 0
    only_replayed: int = 0
    largest: dict[str, float] = field(default_factory=dict)  # numeric field -> largest |difference|
    other: dict[str, int] = field(default_factory=dict)  # field that is no number, or of another shape -> how often

    def add(self, logged: Any, replayed: Any) -> list[FieldDifference]:
        """Compare one pair; returns what differs."""
        found = differences(logged, replayed)
        self.compared += 1
        self.differing += bool(found)
        for one in found:
            if math.isnan(one.largest):
                self.other[one.name] = self.other.get(one.name, 0) + 1
            else:
                self.largest[one.name] = max(one.largest, self.largest.get(one.name, 0.0))
        return found


def differences(logged: Any, replayed: Any, *, prefix: str = "") -> list[FieldDifference]:
    """Every field of two messages of one type whose bytes differ."""
    found: list[FieldDifference] = []
    for one in fields(logged):
        a, b, name = getattr(logged, one.name), getattr(replayed, one.name), prefix + one.name
        if _same(a, b):
            continue
        if is_dataclass(a) and is_dataclass(b):
            found += differences(a, b, prefix=f"{name}.")
        else:
            found.append(FieldDifference(name, _short(a), _short(b), _largest(a, b)))
    return found


def _same(a: Any, b: Any) -> bool:
    if isinstance(a, np.ndarray) and isinstance(b, np.ndarray):  # maps are large: no copies of them
        alike = a.dtype == b.dtype and a.shape == b.shape
        return alike and np.array_equal(_bytes(a), _bytes(b))
    return encode(a) == encode(b)


def _bytes(a: NDArray[Any]) -> NDArray[np.uint8]:
    return np.ascontiguousarray(a).reshape(-1).view(np.uint8)


def _largest(a: Any, b: Any) -> float:
    """Largest |a - b|; infinite where only one is NaN; NaN where they cannot be subtracted."""
    if isinstance(a, bool | str | bytes) or isinstance(b, bool | str | bytes):
        return math.nan
    x, y = np.asarray(a), np.asarray(b)
    if x.shape != y.shape or x.dtype.kind not in "fiu" or y.dtype.kind not in "fiu":
        return math.nan
    if x.dtype.kind in "iu" and x.ndim == 0:
        return float(abs(int(x) - int(y)))  # stamps: float64 has no single nanoseconds
    with np.errstate(invalid="ignore"):
        gap = np.abs(x.astype(float) - y.astype(float))
    gap = np.where((x == y) | (_nan(x) & _nan(y)), 0.0, np.where(np.isnan(gap), math.inf, gap))
    return float(gap.max(initial=0.0))


def _nan(x: Any) -> Any:
    return np.isnan(x) if x.dtype.kind == "f" else np.zeros(x.shape, bool)


def _short(value: Any) -> str:
    if isinstance(value, np.ndarray):
        shape = " x ".join(map(str, value.shape))
        inside = np.array2string(value, precision=6, threshold=12, edgeitems=3, separator=", ")
        return f"{inside} ({shape})" if value.size <= 18 and value.ndim == 1 else f"{value.dtype} array {shape}"
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."
