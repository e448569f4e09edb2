"""What every message is: arrays of known types in a frozen record."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, TypeVar, dataclass_transform

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Array32 = NDArray[np.float32]
Bytes2D = NDArray[np.uint8]
T = TypeVar("T")


@dataclass_transform(frozen_default=True, kw_only_default=True, eq_default=False)
def message(kind: type[T]) -> type[T]:
    """Frozen, slotted, keywords only; compared by identity since arrays have no single truth."""
    return dataclass(frozen=True, slots=True, kw_only=True, eq=False)(kind)


def freeze(value: Any) -> Any:
    """Make the arrays of a message read-only; returns the message."""
    for name in value.__slots__:
        part = getattr(value, name)
        if isinstance(part, np.ndarray):
            part.flags.writeable = False
    return value
