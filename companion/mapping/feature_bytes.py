"""Landmarks as bytes: magic, version, count, next id, rows ordered by id, CRC-32; little-endian.

The checksum covers all that is before it, so that a flipped bit anywhere is told, never read.
"""

from __future__ import annotations

import struct
import zlib
from typing import Any

import numpy as np
from numpy.typing import NDArray

from companion.core.errors import InputError
from companion.mapping.association import DESCRIPTOR_BYTES, KINDS, are_covariances

MAGIC, VERSION = b"UFEATURE", 1
LANDMARK = np.dtype(
    [
        ("id", "<i8"),
        ("position_odom", "<f8", (3,)),
        ("covariance", "<f8", (3, 3)),
        ("radius_m", "<f8"),  # NaN: has none
        ("first_ns", "<i8"),
        ("last_ns", "<i8"),
        ("observations", "<i4"),
        ("kind", "u1"),  # index of association.KINDS
        ("descriptor", "u1", (DESCRIPTOR_BYTES,)),
    ]
)
_HEAD = struct.Struct("<8sIQq")  # magic, version, count, next id
_SUM = struct.Struct("<I")


def pack(landmarks: NDArray[Any], next_id: int) -> bytes:
    """Bytes of landmarks (N,) of LANDMARK, ordered by id."""
    body = _HEAD.pack(MAGIC, VERSION, len(landmarks), next_id) + landmarks.tobytes()
    return body + _SUM.pack(zlib.crc32(body))


def unpack(data: bytes, *, most: int) -> tuple[NDArray[Any], int]:
    """Landmarks and the next id; InputError that says what is wrong."""
    if len(data) < _HEAD.size + _SUM.size or data[: len(MAGIC)] != MAGIC:
        raise InputError("no feature map", field="features", valid=f"bytes that begin with {MAGIC.decode()}")
    _, version, count, next_id = _HEAD.unpack_from(data)
    if version != VERSION:
        raise InputError(f"version {version}", field="features", valid=str(VERSION))
    if len(data) != _HEAD.size + count * LANDMARK.itemsize + _SUM.size:
        raise InputError(f"{len(data)} bytes are no {count} landmarks: cut or damaged", field="features")
    if zlib.crc32(data[: -_SUM.size]) != _SUM.unpack_from(data, len(data) - _SUM.size)[0]:
        raise InputError("damaged: the checksum does not fit", field="features")
    landmarks = np.frombuffer(data, LANDMARK, count, _HEAD.size).copy()
    _check(landmarks, next_id, most)
    return landmarks, next_id


def _check(landmarks: NDArray[Any], next_id: int, most: int) -> None:
    """A valid checksum says only that somebody meant it."""
    if len(landmarks) > most:
        raise InputError(f"{len(landmarks)} landmarks", field="features", valid=f"up to {most}")
    if len(landmarks) == 0:
        return
    ids = landmarks["id"]
    if np.any(np.diff(ids) <= 0) or ids[0] < 0 or ids[-1] >= next_id:
        raise InputError("ids do not grow", field="features.id", valid=f"0 to {next_id - 1}, each once")
    if np.any(landmarks["kind"] >= len(KINDS)):
        raise InputError("an unknown kind", field="features.kind", valid=", ".join(KINDS))
    if not np.all(np.abs(landmarks["position_odom"]) < 1e6):
        raise InputError("a place that is none", field="features.position_odom", valid="within 1000 km")
    if not np.all(are_covariances(landmarks["covariance"])):
        raise InputError("not positive definite", field="features.covariance")
    if np.any(landmarks["observations"] < 1):
        raise InputError("a landmark that nobody saw", field="features.observations", valid="1 or more")
