"""MAVLink 2 on bytes: packing and finding frames with `struct` and `fastcrc`.

    encoder, parser = Encoder(system=1, component=1), Parser()
    data = encoder(TIMESYNC, 0, now_ns)               # values flat, in the order of the wire
    for frame in parser.feed(data): frame.values

The layouts come from pymavlink's own classes, so names, sizes and seeds cannot drift.
Source: mavlink.io/en/guide/serialization.html.
"""

from __future__ import annotations

import re
import struct
from typing import Any, Final, NamedTuple

from fastcrc.crc16 import mcrf4xx
from pymavlink.dialects.v20 import all as dialect

from sim.autopilot.signing import SIGNED, Signing


class Layout(NamedTuple):
    """One message type on the wire."""

    name: str
    msg_id: int
    seed: bytes  # CRC_EXTRA
    packer: struct.Struct  # all fields flat, extensions included
    fields: tuple[str, ...]  # in the order of the wire
    lengths: tuple[int, ...]  # values per field: 1, or that of an array; char[n] is one value

    def unflatten(self, values: tuple[Any, ...]) -> dict[str, Any]:
        """Field name -> value, or tuple of values for an array."""
        named, at = {}, 0
        for field, length in zip(self.fields, self.lengths, strict=True):
            named[field] = values[at] if length == 1 else values[at : at + length]
            at += length
        return named


def _layout(cls: Any) -> Layout:
    lengths = [max(1, n) for n in cls.array_lengths]
    chars = dict(zip(cls.fieldnames, cls.fieldtypes, strict=True))
    flat = [1 if chars[f] == "char" else n for f, n in zip(cls.ordered_fieldnames, lengths, strict=True)]
    name: str = cls.msgname
    return Layout(name, cls.id, bytes([cls.crc_extra]), cls.unpacker, tuple(cls.ordered_fieldnames), tuple(flat))


LAYOUTS: Final[dict[int, Layout]] = {i: _layout(cls) for i, cls in dialect.mavlink_map.items()}
BY_NAME: Final[dict[str, Layout]] = {layout.name: layout for layout in LAYOUTS.values()}

_HEAD = struct.Struct("<BBBBBBHB")  # length, incompatible, compatible, seq, system, component, id
_START = re.compile(b"[\xfd\xfe]")


class Encoder:
    """Packs the messages of one sender, counts their sequence, signs them if it has a key."""

    def __init__(self, *, system: int, component: int, signing: Signing | None = None) -> None:
        self._system, self._component, self._sequence = system, component, 0
        self._signing, self._flags = signing, SIGNED if signing else 0

    def __call__(self, layout: Layout, *values: Any) -> bytes:
        """One whole frame; raises struct.error if a value does not fit its field."""
        payload = layout.packer.pack(*values).rstrip(b"\0") or b"\0"
        sequence, msg_id = self._sequence, layout.msg_id
        self._sequence = (sequence + 1) & 0xFF
        body = (
            _HEAD.pack(
                len(payload), self._flags, 0, sequence, self._system, self._component, msg_id & 0xFFFF, msg_id >> 16
            )
            + payload
        )
        frame = b"\xfd" + body + mcrf4xx(body + layout.seed).to_bytes(2, "little")
        return frame + self._signing.tail(frame) if self._signing else frame


class Frame(NamedTuple):
    """One intact message from somebody."""

    layout: Layout
    system: int
    component: int
    values: tuple[Any, ...]  # flat, in the order of the wire; cut zeros are back

    @property
    def named(self) -> dict[str, Any]:
        """Values by field name: slower, for the rare messages."""
        return self.layout.unflatten(self.values)


class Parser:
    """Finds frames of version 1 and 2 in a stream of bytes cut anywhere; never raises.

    Damaged bytes are skipped to the next possible start. Frames of unknown types, or with
    incompatibility flags other than "signed", are passed over. With `signing`, frames that it
    refuses are as if they had not come; without, signatures are not looked at.
    """

    def __init__(self, *, signing: Signing | None = None) -> None:
        self._signing = signing
        self._rest = b""
        self.damaged = 0  # bytes at which no frame started

    def feed(self, data: bytes) -> list[Frame]:
        """All frames that `data` completes, in order."""
        data = self._rest + data if self._rest else data
        found: list[Frame] = []
        at, size = 0, len(data)
        while at < size:
            length = self._frame_length(data, at)
            if length > size - at:
                break
            frame = self._read(data, at, length) if length else None
            if frame is None:
                self.damaged += 1
                start = _START.search(data, at + 1)
                at = start.start() if start else size
            else:
                if self._signing is None or self._signing.accepts(data[at : at + length]):
                    found.append(frame)
                at += length
        self._rest = data[at:]
        return found

    @staticmethod
    def _frame_length(data: bytes, at: int) -> int:
        """Bytes of the frame that may start here: 0 if none can, more than there are if unknown."""
        left = len(data) - at
        if data[at] == 0xFD:
            if left < 3:
                return left + 1
            return 0 if data[at + 2] & ~1 else 12 + data[at + 1] + (13 if data[at + 2] else 0)
        if data[at] == 0xFE:
            return left + 1 if left < 2 else 8 + data[at + 1]
        return 0

    @staticmethod
    def _read(data: bytes, at: int, length: int) -> Frame | None:
        if data[at] == 0xFD:
            size, _, _, _, system, component, low, high = _HEAD.unpack_from(data, at + 1)
            msg_id, start = low | high << 16, at + 10
        else:
            size, system, component, msg_id = data[at + 1], data[at + 3], data[at + 4], data[at + 5]
            start = at + 6
        layout = LAYOUTS.get(msg_id)
        stop = start + size
        if layout is None or mcrf4xx(data[at + 1 : stop] + layout.seed) != data[stop] | data[stop + 1] << 8:
            return None
        payload, full = data[start:stop], layout.packer.size
        values = layout.packer.unpack(payload[:full] if size >= full else payload.ljust(full, b"\0"))
        return Frame(layout, system, component, values)
