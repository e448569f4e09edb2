"""MAVLink framing: where a frame starts and ends, and whether it arrived intact.

Source: mavlink.io/en/guide/serialization.html (frame layouts, CRC_EXTRA, signature size).
"""

from __future__ import annotations

import re
import struct
from collections.abc import Collection
from typing import Final, Literal, NamedTuple

from fastcrc.crc16 import mcrf4xx
from pymavlink.dialects.v20 import all as dialect

from companion.autopilot.signing import Signing

MAGIC_V1: Final = 0xFE
MAGIC_V2: Final = 0xFD
SIGNED_FLAG: Final = 0x01
SIGNATURE_SIZE: Final = 13

# What PX4 sends and pymavlink's XML lacks; the seeds were read off recorded PX4 traffic (one
# seed fits every frame of an id) and are checked against it in the tests.
PX4_ONLY: Final[dict[int, tuple[str, int]]] = {
    8: ("LINK_NODE_STATUS", 117),
    290: ("ESC_INFO", 251),
    291: ("ESC_STATUS", 10),
    380: ("TIME_ESTIMATE_TO_TARGET", 232),
    410: ("EVENT", 160),
    411: ("CURRENT_EVENT_SEQUENCE", 106),
}
CRC_EXTRA: Final[dict[int, int]] = {
    **{i: m.crc_extra for i, m in dialect.mavlink_map.items()},
    **{i: seed for i, (_, seed) in PX4_ONLY.items()},
}
NAMES: Final[dict[int, str]] = {
    **{i: m.msgname for i, m in dialect.mavlink_map.items()},
    **{i: name for i, (name, _) in PX4_ONLY.items()},
}

_V1 = struct.Struct("<BBBBB")  # length, sequence, system, component, id
_V2 = struct.Struct("<BBBBBBHB")  # length, incompatible, compatible, sequence, system, component, id
_MAGICS = re.compile(b"[\xfd\xfe]")
_SEED_BYTES = [bytes([i]) for i in range(256)]


class Frame(NamedTuple):
    """One intact frame; the payload is as on the wire (v2 cuts trailing zeros off)."""

    msg_id: int
    system: int
    component: int
    sequence: int
    signed: bool  # carries a signature; a Parser with a key has verified it
    known: bool  # the id is in the table, so the CRC proves the frame
    payload: bytes
    size: int  # bytes of the whole frame

    @property
    def name(self) -> str:
        """MAVLink's name of the message, `UNKNOWN_<id>` for an id without definition."""
        return NAMES.get(self.msg_id, f"UNKNOWN_{self.msg_id}")


def read_frame(data: bytes, at: int) -> Frame | Literal["more", "bad"]:
    """The frame that starts at `data[at]`, or why there is none: bytes lack, or it is no frame.

    A frame of an unknown id cannot be proven; it passes if any of the 256 seeds fits its
    CRC (noise: 1 in 256), so that one new message does not cost a search through it.
    """
    left = len(data) - at
    if data[at] == MAGIC_V2:
        if left >= 3 and data[at + 2] & ~SIGNED_FLAG:
            return "bad"  # a flag that we cannot honour: the standard says drop
        if left < 12:
            return "more"
        length, flags, _, sequence, system, component, low, high = _V2.unpack_from(data, at + 1)
        msg_id, signed, start = low | high << 16, bool(flags), at + 10
    elif data[at] == MAGIC_V1:
        if left < 8:
            return "more"
        length, sequence, system, component, msg_id = _V1.unpack_from(data, at + 1)
        signed, start = False, at + 6
    else:
        return "bad"
    stop = start + length
    size = stop + 2 - at + (SIGNATURE_SIZE if signed else 0)
    if left < size:
        return "more"
    crc, found = mcrf4xx(data[at + 1 : stop]), data[stop] | data[stop + 1] << 8
    seed = CRC_EXTRA.get(msg_id)
    if seed is None:
        if fitting_seed(crc, found) is None:
            return "bad"
    elif mcrf4xx(_SEED_BYTES[seed], crc) != found:
        return "bad"
    return Frame(msg_id, system, component, sequence, signed, seed is not None, data[start:stop], size)


def fitting_seed(crc: int, found: int) -> int | None:
    """The CRC_EXTRA that turns `crc` (header and payload) into the checksum `found`, if any."""
    fits = (seed for seed in range(256) if mcrf4xx(_SEED_BYTES[seed], crc) == found)
    return next(fits, None)


class Parser:
    """Frames out of a byte stream cut anywhere: `for frame in parser.feed(data): ...`.

    Never raises. After damage it goes on at the next byte that can start a frame; a run of
    bytes between two intact frames counts as one corrupt piece. The frames found do not
    depend on how the stream was cut into pieces.
    """

    def __init__(self, wanted: Collection[int] | None = None, *, signing: Signing | None = None) -> None:
        """Return only frames with these ids (None: all); the others are checked and counted.

        With `signing`, a frame that it does not accept is as if it had not come.
        """
        self._signing = signing
        self._wanted = None if wanted is None else frozenset(wanted)
        self._rest = b""
        self._in_damage = False
        self.frames = 0  # intact, wanted or not
        self.unknown = 0  # of these, without definition
        self.signed = 0
        self.corrupt_pieces = 0
        self.skipped_bytes = 0

    def feed(self, data: bytes, now_ns: int = 0) -> list[Frame]:
        """All wanted frames that `data` completes, in order; `now_ns` matters to signatures only."""
        if self._rest:
            data = self._rest + data
        found: list[Frame] = []
        signing = self._signing
        at, size = 0, len(data)
        while at < size:
            frame = read_frame(data, at)
            if isinstance(frame, Frame):
                self._count(frame)
                wanted = self._wanted is None or frame.msg_id in self._wanted
                if (signing is None or signing.accepts(data[at : at + frame.size], now_ns)) and wanted:
                    found.append(frame)
                at += frame.size
            elif frame == "bad":
                at = self._skip(data, at)
            else:
                break
        self._rest = data[at:]
        return found

    def _count(self, frame: Frame) -> None:
        self._in_damage = False
        self.frames += 1
        if frame.signed:
            self.signed += 1
        if not frame.known:
            self.unknown += 1

    def _skip(self, data: bytes, at: int) -> int:
        if not self._in_damage:
            self._in_damage = True
            self.corrupt_pieces += 1
        following = _MAGICS.search(data, at + 1)
        to = following.start() if following else len(data)
        self.skipped_bytes += to - at
        return to
