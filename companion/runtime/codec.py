"""Messages to bytes and back: MessagePack, arrays as (dtype, shape, raw bytes)."""

from __future__ import annotations

from typing import Any

import msgspec
import numpy as np


def encode(message: Any) -> bytes:
    """One message as MessagePack; equal messages give equal bytes."""
    return _encoder.encode(message)


def encode_into(message: Any, buffer: bytearray) -> bytearray:
    """`encode` into memory that is there: for what is many megabytes, many times a second."""
    _encoder.encode_into(message, buffer)
    return buffer


def decode(data: bytes, kind: type[Any]) -> Any:
    """Inverse of `encode`; arrays come back read-only."""
    if kind not in _decoders:
        _decoders[kind] = msgspec.msgpack.Decoder(kind, dec_hook=_decode_array)
    return _decoders[kind].decode(data)


def _encode_array(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return (value.dtype.str, value.shape, np.ascontiguousarray(value).data)
    if isinstance(value, np.generic):
        return value.item()
    raise NotImplementedError(f"{type(value).__name__} is no message field")


def _decode_array(_kind: type[Any], value: Any) -> Any:
    dtype, shape, data = value
    return np.frombuffer(data, dtype).reshape(shape)


_encoder = msgspec.msgpack.Encoder(enc_hook=_encode_array)
_decoders: dict[type[Any], msgspec.msgpack.Decoder[Any]] = {}
