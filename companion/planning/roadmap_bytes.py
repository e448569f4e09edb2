"""A roadmap as bytes: one section of a map file. Little-endian; a checksum at the end over all before it.

4  magic `UPRM`     2  version     2  links     4  N     4  E
24 N  places, m     4 (N + 1)  first     4 E  after     4  CRC-32
"""

from __future__ import annotations

import struct
import zlib
from typing import Any

import numpy as np
from numpy.typing import NDArray

from companion.core.errors import InputError
from companion.core.messages import Array

_HEAD = struct.Struct("<4sHHII")
_MAGIC, _VERSION = b"UPRM", 1
Numbers = NDArray[np.int32]


def pack(points: Array, first: Numbers, after: Numbers, links: int) -> bytes:
    """The arrays of a `Roadmap` as bytes."""
    head = _HEAD.pack(_MAGIC, _VERSION, links, len(points), len(after))
    body = head + points.astype("<f8").tobytes() + first.astype("<i4").tobytes() + after.astype("<i4").tobytes()
    return body + struct.pack("<I", zlib.crc32(body))


def unpack(data: bytes) -> tuple[Array, Numbers, Numbers, int]:
    """points, first, after, links; raises InputError that says what is wrong."""
    if len(data) < _HEAD.size + 8 or data[:4] != _MAGIC:
        raise _wrong("these bytes are no roadmap")
    _, version, links, places, edges = _HEAD.unpack_from(data)
    if version != _VERSION:
        raise _wrong(f"version {version} is not known", valid=str(_VERSION))
    if len(data) != _HEAD.size + 24 * places + 4 * (places + 1) + 4 * edges + 4:
        raise _wrong(f"{len(data)} bytes are not those of {places} places and {edges} edges")
    if struct.unpack("<I", data[-4:])[0] != zlib.crc32(data[:-4]):
        raise _wrong("the checksum does not fit: the bytes are damaged")
    points = _numbers(data, "<f8", _HEAD.size, 3 * places).astype(np.float64).reshape(-1, 3)
    first = _numbers(data, "<i4", _HEAD.size + 24 * places, places + 1).astype(np.int32)
    after = _numbers(data, "<i4", _HEAD.size + 24 * places + 4 * (places + 1), edges).astype(np.int32)
    _check(points, first, after)
    return points, first, after, links


def _check(points: Array, first: Numbers, after: Numbers) -> None:
    """The kernels trust the numbers."""
    if not np.isfinite(points).all():
        raise _wrong("a place is not finite")
    if first[0] != 0 or first[-1] != len(after) or np.any(np.diff(first) < 0):
        raise _wrong("the edges are not in the order of their places")
    if len(after) and (after.min() < 0 or after.max() >= len(points)):
        raise _wrong("an edge leads to no place")


def _numbers(data: bytes, kind: str, offset: int, count: int) -> NDArray[Any]:
    return np.frombuffer(data, kind, count=count, offset=offset)


def _wrong(problem: str, valid: str = "") -> InputError:
    return InputError(problem, field="roadmap", valid=valid)
