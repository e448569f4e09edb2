"""Our own map file, `.umap`: blocks in order of position, named further sections, one checksum over all.

    magic 8 | version u32 | header size u32 | header, JSON | sections, zlib each | xxh3-128 of all before

Little-endian. The same map gives the same bytes. `positions` are the blocks' coordinates as differences
(int32, 3 per block), `log_odds` their cells (int8, 512 per block). A reader keeps sections it does not
know, unless they are marked as needed to understand the map.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable, Iterator

import msgspec
import numpy as np
import xxhash
from numpy.typing import NDArray

from companion.core.errors import InputError
from companion.mapping.formats.octomap import MOST_BLOCKS
from companion.mapping.formats.stored_map import StoredMap
from companion.mapping.rays import CELLS
from companion.mapping.sensor_model import SensorModel, quantise

MAGIC, VERSION = b"UMAP\r\n\x1a\n", 1  # a transfer as text would change the line end, and be told
POSITIONS, LOG_ODDS = "positions", "log_odds"
MOST_SECTION_BYTES = 1 << 30  # of what is not blocks
_HEAD = struct.Struct("<8sII")
_SUM_BYTES = 16
_LEVEL = 6  # level 9 takes seven times as long and saves 3 %
_PIECE = 1 << 22  # bytes between two reports of progress
Progress = Callable[[float], None]  # is told the share that is done


class Section(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """One section, as the header names it."""

    name: str
    size: int  # bytes
    stored: int  # bytes in the file
    needed: bool = False  # without it the map would be misread


class Header(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """What the file holds."""

    resolution_m: float
    sensor: SensorModel
    frame: str
    blocks: int
    created_by: str
    sections: tuple[Section, ...]  # in order of the file


def pack(stored: StoredMap, *, on_progress: Progress | None = None) -> bytes:
    """The file's bytes; InputError if the map is none."""
    stored = stored.canonical()
    parts = {
        POSITIONS: np.diff(stored.block_xyz, axis=0, prepend=np.int32(0)).astype("<i4").tobytes(),
        LOG_ODDS: stored.log_odds.tobytes(),
        **{name: stored.sections[name] for name in sorted(stored.sections)},
    }
    if len(parts) != 2 + len(stored.sections):
        raise InputError("a name that the blocks have", field="sections", valid=f"not {POSITIONS}, {LOG_ODDS}")
    report = _share_of(sum(len(part) for part in parts.values()), on_progress)
    packed = {name: _compress(part, report) for name, part in parts.items()}
    entries = tuple(
        Section(name=name, size=len(parts[name]), stored=len(data), needed=name in (POSITIONS, LOG_ODDS))
        for name, data in packed.items()
    )
    header = msgspec.json.encode(
        Header(
            resolution_m=float(stored.resolution_m),
            sensor=stored.sensor,
            frame=stored.frame,
            blocks=len(stored.block_xyz),
            created_by=stored.created_by,
            sections=entries,
        )
    )
    body = b"".join([_HEAD.pack(MAGIC, VERSION, len(header)), header, *packed.values()])
    return body + xxhash.xxh3_128_digest(body)


def unpack(
    data: bytes, *, file: str = "", on_progress: Progress | None = None, most_blocks: int = MOST_BLOCKS
) -> StoredMap:
    """The map of a file; InputError that names `file` and says what is wrong."""
    try:
        header, begin = _open(data)
        if header.blocks > most_blocks:
            raise InputError(f"{header.blocks:,} blocks", field="blocks", valid=f"up to {most_blocks:,}")
        parts = dict(_sections(data, header, begin, on_progress))
        xyz, log_odds = _blocks(parts.pop(POSITIONS, b""), parts.pop(LOG_ODDS, b""), header)
        made = StoredMap(header.resolution_m, header.sensor, xyz, log_odds, header.frame, header.created_by, parts)
        return made.canonical()
    except InputError as error:
        raise InputError(error.problem, file=file, field=error.field, valid=error.valid) from error


def read_header(data: bytes, *, file: str = "") -> Header:
    """What the file says that it holds, its checksum tried; InputError as of `unpack`."""
    try:
        return _open(data)[0]
    except InputError as error:
        raise InputError(error.problem, file=file, field=error.field, valid=error.valid) from error


def _open(data: bytes) -> tuple[Header, int]:
    """The header, and where the sections begin."""
    if data[: len(MAGIC)] != MAGIC:
        raise InputError("no .umap", valid=f"a file that begins with {MAGIC!r}")
    if len(data) < _HEAD.size + _SUM_BYTES:
        raise InputError("cut off in its first bytes", valid="a whole .umap")
    _, version, size = _HEAD.unpack_from(data)
    if version != VERSION:
        raise InputError(f"format {version}", field="version", valid=str(VERSION))
    if xxhash.xxh3_128_digest(data[:-_SUM_BYTES]) != data[-_SUM_BYTES:]:
        raise InputError(_damage(data, size), valid="a whole .umap")
    return _header(data, size), _HEAD.size + size


def _header(data: bytes, size: int) -> Header:
    begin = _HEAD.size
    try:
        header = msgspec.json.decode(data[begin : begin + size], type=Header)
        quantise(header.sensor)
    except msgspec.ValidationError as error:
        raise InputError(f"not of this format: {error}", field="header") from error
    except (msgspec.DecodeError, UnicodeDecodeError) as error:
        raise InputError("is no JSON", field="header") from error
    if len({s.name for s in header.sections}) != len(header.sections) or header.blocks < 0:
        raise InputError("names a section twice, or less than no blocks", field="header")
    stored = [s.stored for s in header.sections]
    if min(stored, default=0) < 0 or begin + size + sum(stored) + _SUM_BYTES != len(data):
        raise InputError("sections do not fill the file", field="header.sections")
    return header


def _damage(data: bytes, size: int) -> str:
    """The most likely story of bytes whose checksum does not fit."""
    try:
        header = msgspec.json.decode(data[_HEAD.size : _HEAD.size + size], type=Header)
        whole = _HEAD.size + size + sum(s.stored for s in header.sections) + _SUM_BYTES
    except (msgspec.DecodeError, UnicodeDecodeError, InputError):
        return "damaged or cut off: the checksum does not fit"
    if len(data) < whole:
        return f"cut off: {len(data):,} of {whole:,} bytes"
    return "damaged: the checksum does not fit"


def _sections(data: bytes, header: Header, begin: int, on_progress: Progress | None) -> Iterator[tuple[str, bytes]]:
    known = {POSITIONS: 12 * header.blocks, LOG_ODDS: CELLS * header.blocks}
    report = _share_of(sum(s.size for s in header.sections), on_progress)
    for section in header.sections:
        if section.needed and section.name not in known:
            raise InputError(f"{section.name!r} is of a newer version", field="sections", valid=", ".join(known))
        if not 0 <= section.size <= MOST_SECTION_BYTES and section.name not in known:
            raise InputError(f"{section.size:,} bytes", field=section.name, valid=f"up to {MOST_SECTION_BYTES:,}")
        if known.get(section.name, section.size) != section.size:
            raise InputError(f"{section.size:,} bytes are not {header.blocks:,} blocks", field=section.name)
        yield section.name, _expand(data[begin : begin + section.stored], section, report)
        begin += section.stored


def _blocks(positions: bytes, log_odds: bytes, header: Header) -> tuple[NDArray[np.int32], NDArray[np.int8]]:
    if len(log_odds) != CELLS * header.blocks or len(positions) != 12 * header.blocks:
        raise InputError("a section of the blocks is missing", field="sections", valid=f"{POSITIONS}, {LOG_ODDS}")
    steps = np.frombuffer(positions, "<i4").reshape(-1, 3)
    xyz = np.cumsum(steps, axis=0, dtype=np.int32)
    return xyz, np.frombuffer(log_odds, np.int8).reshape(-1, CELLS)


def _compress(part: bytes, report: Callable[[int], None]) -> bytes:
    worker, out = zlib.compressobj(_LEVEL), []
    for begin in range(0, len(part), _PIECE):
        piece = part[begin : begin + _PIECE]
        out.append(worker.compress(piece))
        report(len(piece))
    return b"".join([*out, worker.flush()])


def _expand(packed: bytes, section: Section, report: Callable[[int], None]) -> bytes:
    """The bytes of a section, never more than it promises."""
    worker, out, size = zlib.decompressobj(), [], 0
    try:
        while not worker.eof and size <= section.size:
            piece = worker.decompress(packed, min(_PIECE, section.size + 1 - size) or 1)
            packed = worker.unconsumed_tail
            if not piece and not packed:
                break
            out.append(piece)
            size += len(piece)
            report(len(piece))
    except zlib.error as error:
        raise InputError("damaged: cannot be expanded", field=section.name) from error
    if not worker.eof or size != section.size or worker.unused_data:
        raise InputError(f"does not expand to {section.size:,} bytes", field=section.name)
    return b"".join(out)


def _share_of(total: int, on_progress: Progress | None) -> Callable[[int], None]:
    done = 0

    def report(count: int) -> None:
        nonlocal done
        done += count
        if on_progress is not None:
            on_progress(done / max(total, 1))

    return report
