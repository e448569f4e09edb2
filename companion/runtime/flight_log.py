"""The log of a flight: every message once, every delivery in order, and the flight's hash.

A file of entries, each a 4-byte little-endian length and a MessagePack array:
`[0, time_ns, source, topic, payload]` per message (payload nil where the topic is not
stored; its digest still counts) and `[1, time_ns, node, event, message number]` per
delivery or tick (number -1). Replaying a node's deliveries reproduces its outputs.
"""

from __future__ import annotations

import hashlib
from collections import Counter, defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO

import msgspec
from xxhash import xxh3_128_hexdigest

from companion.core.node import Topic
from companion.runtime.codec import encode, encode_into


class FlightLog:
    """A tap that hashes everything and stores what the topic table says."""

    def __init__(self, path: Path | None, *, store_all: bool = False) -> None:
        self.counts: Counter[str] = Counter()
        self._file: BinaryIO | None = path.open("wb", buffering=1 << 20) if path else None
        self._store_all = store_all
        self._hash = hashlib.sha256()
        self._number = -1
        self._scratch: defaultdict[str, bytearray] = defaultdict(bytearray)  # by topic: sizes repeat
        self._pack = msgspec.msgpack.Encoder().encode

    @property
    def flight_hash(self) -> str:
        """SHA-256 over time, source, topic and XXH3-128 of the bytes of every message so far."""
        return self._hash.hexdigest()

    def published(self, now_ns: int, source: str, topic: Topic[Any], message: Any) -> int:
        """Hash a message, store it where its topic is recorded; returns its number."""
        stored = topic.recorded or self._store_all
        data = encode(message) if stored else encode_into(message, self._scratch[topic.name])
        # Maps are 100 MB per flown second: a fast digest of each message, a strong hash over the digests.
        self._hash.update(f"{now_ns} {source} {topic.name} {len(data)} {xxh3_128_hexdigest(data)} ".encode())
        self.counts[topic.name] += 1
        self._number += 1
        self._write((0, now_ns, source, topic.name, data if stored else None))
        return self._number

    def fed(self, now_ns: int, node: str, event: str, number: int) -> None:
        """Store one delivery."""
        self._write((1, now_ns, node, event, number))

    def _write(self, entry: tuple[Any, ...]) -> None:
        if self._file:
            data = self._pack(entry)
            self._file.write(len(data).to_bytes(4, "little") + data)

    def close(self) -> None:
        """Flush and close the file."""
        if self._file:
            self._file.close()


def read_log(path: Path) -> Iterator[list[Any]]:
    """The entries of a flight log, in order; a torn last entry is left out."""
    with path.open("rb") as file:
        while len(head := file.read(4)) == 4:
            entry = file.read(int.from_bytes(head, "little"))
            if len(entry) == int.from_bytes(head, "little"):
                yield msgspec.msgpack.decode(entry)
