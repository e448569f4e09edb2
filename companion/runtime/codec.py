"""Messages to bytes and back: MessagePack, arrays as (dtype, shape, raw bytes)."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

import msgspec
import numpy as np
from xxhash import xxh3_128, xxh3_128_digest


def encode(message: Any) -> bytes:
    """One message as MessagePack; equal messages give equal bytes."""
    return _encoder.encode(message)


def summed(message: Any, *, stored: bool) -> tuple[bytes | None, bytes, int]:
    """(bytes if they are to be stored, their digest, their length): what a log needs of a message."""
    if not stored:
        return None, *digest(message)
    data = encode(message)
    return data, xxh3_128_digest(data), len(data)


def digest(message: Any) -> tuple[bytes, int]:
    """XXH3-128 and length of what `encode` gives, without a copy of its large arrays."""
    parts = fields(message)
    state = xxh3_128(_map_head(len(parts)))
    size = 1
    for part in parts:
        for piece in (_encoder.encode(part.name), *_pieces(getattr(message, part.name))):
            state.update(piece)
            size += len(piece)
    return state.digest(), size


def decode(data: bytes, kind: type[Any]) -> Any:
    """Inverse of `encode`; arrays come back read-only."""
    if kind not in _decoders:
        _decoders[kind] = msgspec.msgpack.Decoder(kind, dec_hook=_decode_array)
    return _decoders[kind].decode(data)


def _pieces(value: Any) -> tuple[Any, ...]:
    """The bytes of one field: as encoded, or the head of a large array and its memory."""
    if not isinstance(value, np.ndarray) or value.nbytes < _LARGE:
        return (_encoder.encode(value),)
    head = b"\x93" + _encoder.encode(value.dtype.str) + _encoder.encode(value.shape)
    return head + b"\xc6" + value.nbytes.to_bytes(4, "big"), np.ascontiguousarray(value).reshape(-1).view(np.uint8).data


def _map_head(count: int) -> bytes:
    assert count < 16  # more fields have another head
    return bytes([0x80 | count])


def _encode_array(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return (value.dtype.str, value.shape, np.ascontiguousarray(value).data)
    if isinstance(value, np.generic):
        return value.item()
    raise NotImplementedError(f"{type(value).__name__} is no message field")


def _decode_array(_kind: type[Any], value: Any) -> Any:
    dtype, shape, data = value
    return np.frombuffer(data, dtype).reshape(shape)


_LARGE = 1 << 16  # MessagePack's binary head of four bytes of length begins here

_encoder = msgspec.msgpack.Encoder(enc_hook=_encode_array)
_decoders: dict[type[Any], msgspec.msgpack.Decoder[Any]] = {}
