"""The file under every log: what went into each node of a process and what came out, in order.

Entries, each a 4-byte little-endian length and a MessagePack array:

    [0, time_ns, source, topic, payload, digest]   a message; payload nil where it is not stored
    [1, time_ns, node, event, message number]      a delivery (event: topic) or a tick (event: timer, number -1)
    [2, header]                                    what the nodes are rebuilt from; once, the first
    [3, time_ns, reason]                           the log was closed ("") or had to stop

Messages are numbered from 0 in the order of the file. The digest is XXH3-128 of the message's bytes
(`companion.runtime.codec`), also of those that are not stored: a replay can verify them all the same.
A source that is no node of the header is outside the process: nobody in it can compute its messages
again, so a replay needs them stored.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, Literal

import msgspec

import companion
from companion.core.errors import CompanionError

MESSAGE, FED, HEADER, END = range(4)
VERSION = 1
Store = Literal["inputs", "recorded", "all"]
"""What is stored in full: what comes from outside; also what the topic table records; everything."""


class LogDamaged(CompanionError):
    """The log holds something that nobody wrote."""

    def __init__(self, what: str) -> None:
        super().__init__(f"log damaged: {what}")


class Header(msgspec.Struct, frozen=True, kw_only=True):
    """What a replay needs to build the nodes again."""

    group: str
    nodes: tuple[str, ...]
    seed: int
    mission: str  # the text of the mission file
    config: str  # the whole configuration as YAML
    signed: bool = False  # a key signed the link; the log does not hold it
    epoch_ns: int = 0  # offset of stamps to the monotonic clock; 0: simulated time
    version: int = VERSION
    package: str = companion.__version__


@dataclass(frozen=True, slots=True)
class Message:
    """One published or received message."""

    time_ns: int
    source: str
    topic: str
    payload: bytes | None
    digest: bytes


@dataclass(frozen=True, slots=True)
class Fed:
    """One delivery, or tick (number -1)."""

    time_ns: int
    node: str
    event: str
    number: int


@dataclass(frozen=True, slots=True)
class End:
    """The log was closed, or stopped for a reason."""

    time_ns: int
    reason: str


Entry = Header | Message | Fed | End


class LogFile:
    """Writes entries; not thread-safe."""

    def __init__(self, path: Path) -> None:
        self._file: BinaryIO = path.open("wb", buffering=1 << 20)
        self._pack = msgspec.msgpack.Encoder().encode

    def header(self, header: Header) -> None:
        """The first entry."""
        self._write((HEADER, msgspec.to_builtins(header)))

    def message(self, time_ns: int, source: str, topic: str, payload: bytes | None, digest: bytes) -> None:
        """One message."""
        self._write((MESSAGE, time_ns, source, topic, payload, digest))

    def fed(self, time_ns: int, node: str, event: str, number: int) -> None:
        """One delivery or tick."""
        self._write((FED, time_ns, node, event, number))

    def end(self, time_ns: int, reason: str = "") -> None:
        """The last entry."""
        self._write((END, time_ns, reason))

    def flush(self) -> None:
        """Hand what was written to the system: it survives a kill of this process."""
        self._file.flush()

    def close(self) -> None:
        """Flush and close the file."""
        self._file.close()

    def _write(self, entry: tuple[Any, ...]) -> None:
        data = self._pack(entry)
        self._file.write(len(data).to_bytes(4, "little") + data)


def read_log(path: Path) -> Iterator[list[Any]]:
    """The entries of a log as they are in the file; a torn last entry is left out.

    Raises LogDamaged if an entry is no MessagePack array.
    """
    with path.open("rb") as file:
        while len(head := file.read(4)) == 4:
            at, length = file.tell(), int.from_bytes(head, "little")
            data = file.read(length)
            if len(data) == length:
                yield _unpack(data, path, at)


def entries(path: Path) -> Iterator[Entry]:
    """The entries of a log as values; raises LogDamaged where one makes no sense."""
    for number, raw in enumerate(read_log(path)):
        try:
            yield _entry(raw)
        except (TypeError, ValueError, IndexError) as error:
            raise LogDamaged(f"{path.name}, entry {number}: {error}") from error


def _unpack(data: bytes, path: Path, at: int) -> list[Any]:
    try:
        entry = msgspec.msgpack.decode(data)
    except (msgspec.DecodeError, UnicodeDecodeError) as error:
        raise LogDamaged(f"{path.name}, byte {at}: {error}") from error
    if not isinstance(entry, list) or not entry:
        raise LogDamaged(f"{path.name}, byte {at}: no entry")
    return entry


def _entry(raw: list[Any]) -> Entry:
    kind, rest = raw[0], raw[1:]
    if kind == HEADER:
        return msgspec.convert(rest[0], Header)
    shapes: dict[int, type[Message] | type[Fed] | type[End]] = {MESSAGE: Message, FED: Fed, END: End}
    if kind not in shapes:
        raise ValueError(f"unknown kind {kind!r}")
    shape = shapes[kind]
    names = shape.__dataclass_fields__
    if len(rest) != len(names):
        raise ValueError(f"{len(rest)} values for {shape.__name__}")
    return msgspec.convert(dict(zip(names, rest, strict=True)), shape)
