"""What a recorded MAVLink log (.tlog) holds: messages, rates, sources, damage.

    report = inspect_tlog(Path("flight.tlog").read_bytes())

A tlog is a row of records: the arrival time as 8 bytes, big-endian, in µs since 1970, then
one frame. After damage the reader goes on at the next place that looks like a record.
"""

from __future__ import annotations

import struct
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Final, NamedTuple

from fastcrc.crc16 import mcrf4xx

from companion.autopilot.wire import (
    CRC_EXTRA,
    MAGIC_V1,
    MAGIC_V2,
    NAMES,
    SIGNATURE_SIZE,
    SIGNED_FLAG,
    Frame,
    fitting_seed,
    read_frame,
)

_STAMP = struct.Struct(">Q")
_STAMP_SIZE: Final = 8
_DAY_US: Final = 86_400_000_000
_EPOCH_END_US: Final = 4_102_444_800_000_000  # year 2100: the first stamp has no neighbour
_GAP_MAX: Final = 127  # more: rather a repeated or overtaken number than so many lost messages
_FOREIGN_MIN: Final = 10  # so many mismatches that one seed explains are no accident


class Record(NamedTuple):
    """One intact record."""

    stamp_us: int
    frame: Frame


class Damage(NamedTuple):
    """A run of bytes that is no intact record; id and seed if it looks like a whole frame."""

    size: int
    msg_id: int | None
    seed: int | None  # CRC_EXTRA that would make the checksum right
    cut_off: bool  # the log ends inside it


@dataclass(slots=True)
class Traffic:
    """One kind of message from one sender."""

    name: str
    system: int
    component: int
    count: int = 0
    first_us: int = 0
    last_us: int = 0

    @property
    def rate_hz(self) -> float:
        """Mean rate between its first and last message; 0 for a single one."""
        span_us = self.last_us - self.first_us
        return (self.count - 1) * 1e6 / span_us if span_us > 0 else 0.0


@dataclass(slots=True)
class LogReport:
    """Statistics of one log."""

    size_bytes: int
    messages: int = 0
    unknown: int = 0  # of these, of ids without definition
    signed: int = 0
    missing: int = 0  # lost or damaged, by gaps in each sender's sequence numbers
    first_us: int = 0
    last_us: int = 0
    corrupt_pieces: int = 0
    corrupt_bytes: int = 0
    cut_off_bytes: int = 0  # the last record is not complete
    foreign: dict[str, int] = field(default_factory=dict)  # corrupt by our definition only
    traffic: list[Traffic] = field(default_factory=list)  # by sender, then most frequent first

    @property
    def duration_s(self) -> float:
        """From the first to the last message."""
        return (self.last_us - self.first_us) / 1e6


def inspect_tlog(data: bytes) -> LogReport:
    """Count everything in a log. Never raises, whatever the bytes."""
    report = LogReport(size_bytes=len(data))
    traffic: dict[tuple[int, int, int], Traffic] = {}
    sequences: dict[tuple[int, int], int] = {}
    mismatches: Counter[tuple[int, int]] = Counter()
    for item in read_tlog(data):
        if isinstance(item, Damage):
            _count_damage(report, item, mismatches)
            continue
        _count_record(report, item, traffic)
        sender = item.frame.system, item.frame.component
        gap = (item.frame.sequence - sequences.get(sender, item.frame.sequence - 1) - 1) & 0xFF
        report.missing += gap if gap <= _GAP_MAX else 0
        sequences[sender] = item.frame.sequence
    report.traffic = sorted(traffic.values(), key=lambda t: (t.system, t.component, -t.count, t.name))
    report.foreign = {
        f"{NAMES[msg_id]} (id {msg_id}) with CRC_EXTRA {seed} instead of {CRC_EXTRA[msg_id]}": count
        for (msg_id, seed), count in sorted(mismatches.items())
        if count >= _FOREIGN_MIN
    }
    return report


def _count_record(report: LogReport, record: Record, traffic: dict[tuple[int, int, int], Traffic]) -> None:
    stamp_us, frame = record
    if report.messages == 0:
        report.first_us = stamp_us
    report.messages += 1
    report.unknown += not frame.known
    report.signed += frame.signed
    report.last_us = stamp_us
    key = frame.system, frame.component, frame.msg_id
    if key not in traffic:
        traffic[key] = Traffic(frame.name, frame.system, frame.component, first_us=stamp_us)
    traffic[key].count += 1
    traffic[key].last_us = stamp_us


def _count_damage(report: LogReport, damage: Damage, mismatches: Counter[tuple[int, int]]) -> None:
    if damage.cut_off:
        report.cut_off_bytes += damage.size
        return
    report.corrupt_pieces += 1
    report.corrupt_bytes += damage.size
    if damage.msg_id is not None and damage.seed is not None:
        mismatches[damage.msg_id, damage.seed] += 1


def read_tlog(data: bytes) -> Iterator[Record | Damage]:
    """Records and what lies between them, in order; together they cover every byte."""
    at, last_us = 0, None
    while at < len(data):
        frame = read_frame(data, at + _STAMP_SIZE) if at + _STAMP_SIZE < len(data) else "more"
        if isinstance(frame, Frame):
            last_us = _stamp(data, at, at + _STAMP_SIZE + frame.size, last_us)
            yield Record(last_us, frame)
            at += _STAMP_SIZE + frame.size
            continue
        following = _next_record(data, at, last_us)
        yield _damage(data, at, following)
        at = following if following is not None else len(data)


def _stamp(data: bytes, at: int, following: int, last_us: int | None) -> int:
    """The stamp of an intact frame in its place, or the last one if this one is damaged.

    Far from the last stamp it is damaged, unless the next one agrees with it: then the
    clock was set in between.
    """
    stamp_us = int(_STAMP.unpack_from(data, at)[0])
    if last_us is None and stamp_us <= _EPOCH_END_US:
        return stamp_us
    next_us = int(_STAMP.unpack_from(data, following)[0]) if following + 8 <= len(data) else stamp_us
    if last_us is None:
        return next_us
    agrees = abs(stamp_us - last_us) <= _DAY_US or (abs(stamp_us - next_us) <= _DAY_US and stamp_us <= _EPOCH_END_US)
    return stamp_us if agrees else last_us


def _plausible(data: bytes, at: int, last_us: int | None) -> bool:
    """The stamp there lies within a day of the last one."""
    stamp_us = int(_STAMP.unpack_from(data, at)[0])
    return stamp_us <= _EPOCH_END_US if last_us is None else abs(stamp_us - last_us) <= _DAY_US


def _next_record(data: bytes, at: int, last_us: int | None) -> int | None:
    """Where to go on: behind this frame if a stamp and a frame follow there, else search."""
    stop = _frame_end(data, at + _STAMP_SIZE)
    if stop is not None and _starts_frame(data, stop, last_us):
        return stop
    for start in range(at + 1, len(data) - _STAMP_SIZE):
        if _starts_frame(data, start, last_us) and isinstance(read_frame(data, start + _STAMP_SIZE), Frame):
            return start
    return None


def _starts_frame(data: bytes, at: int, last_us: int | None) -> bool:
    magic_at = at + _STAMP_SIZE
    if magic_at >= len(data) or data[magic_at] not in (MAGIC_V1, MAGIC_V2):
        return False
    return _plausible(data, at, last_us)


def _frame_end(data: bytes, at: int) -> int | None:
    """Behind the frame at `at` if its own length is to be believed, and the data reach so far."""
    if at + 3 > len(data) or data[at] not in (MAGIC_V1, MAGIC_V2):
        return None
    length, flags = data[at + 1], data[at + 2]
    if data[at] == MAGIC_V1:
        stop = at + 6 + length + 2
    else:
        stop = at + 10 + length + 2 + (SIGNATURE_SIZE if flags & SIGNED_FLAG else 0)
    return stop if stop <= len(data) else None


def _damage(data: bytes, at: int, following: int | None) -> Damage:
    size = (len(data) if following is None else following) - at
    start = at + _STAMP_SIZE
    stop = _frame_end(data, start)
    if following is None and stop is None and (start >= len(data) or data[start] in (MAGIC_V1, MAGIC_V2)):
        return Damage(size, None, None, cut_off=True)
    if stop is None or stop != (len(data) if following is None else following):
        return Damage(size, None, None, cut_off=False)
    if data[start] == MAGIC_V1:
        msg_id, body = data[start + 5], start + 6
    else:
        msg_id, body = int.from_bytes(data[start + 7 : start + 10], "little"), start + 10
    end = body + data[start + 1]
    if msg_id not in CRC_EXTRA:
        return Damage(size, None, None, cut_off=False)
    crc, found = mcrf4xx(data[start + 1 : end]), int.from_bytes(data[end : end + 2], "little")
    return Damage(size, msg_id, fitting_seed(crc, found), cut_off=False)
