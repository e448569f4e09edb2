"""The log of a flight in lockstep: every message once, every delivery in order, and the flight's hash.

The simulator is outside of what the log can replay: `record=True` stores what it sends in full.
The file's format: `companion.runtime.log_file`.
"""

from __future__ import annotations

import hashlib
from collections import Counter
from pathlib import Path
from typing import Any

from companion.core.node import Topic
from companion.runtime.codec import summed
from companion.runtime.log_file import Header, LogFile, read_log


class FlightLog:
    """A tap that hashes everything and stores what the topic table says.

    `record`: the messages of everyone who is not in the header, too (`begin`), which a replay needs;
    `store_all`: every message.
    """

    def __init__(self, path: Path | None, *, store_all: bool = False, record: bool = False) -> None:
        self.counts: Counter[str] = Counter()
        self._file = LogFile(path) if path else None
        self._store_all, self._record = store_all, record
        self._nodes: frozenset[str] | None = None
        self._hash = hashlib.sha256()
        self._number = -1
        self._newest_ns = 0

    @property
    def flight_hash(self) -> str:
        """SHA-256 over time, source, topic and XXH3-128 of the bytes of every message so far."""
        return self._hash.hexdigest()

    def begin(self, header: Header) -> None:
        """Say what the nodes are rebuilt from; a log without cannot be replayed."""
        self._nodes = frozenset(header.nodes)
        if self._file:
            self._file.header(header)

    def published(self, now_ns: int, source: str, topic: Topic[Any], message: Any) -> int:
        """Hash a message, store it where its topic is recorded; returns its number."""
        stored = topic.recorded or self._store_all or (self._record and self._is_outside(source))
        data, digest, size = summed(message, stored=stored)
        # Maps are 100 MB per flown second: a fast digest of each message, a strong hash over the digests.
        self._hash.update(f"{now_ns} {source} {topic.name} {size} {digest.hex()} ".encode())
        self.counts[topic.name] += 1
        self._number += 1
        self._newest_ns = now_ns
        if self._file:
            self._file.message(now_ns, source, topic.name, data, digest)
        return self._number

    def fed(self, now_ns: int, node: str, event: str, number: int) -> None:
        """Store one delivery; those of the outside cannot be replayed and are left out."""
        if self._file and not self._is_outside(node):
            self._file.fed(now_ns, node, event, number)

    def close(self) -> None:
        """Flush and close the file."""
        if self._file:
            if self._nodes is not None:
                self._file.end(self._newest_ns)
            self._file.close()

    def _is_outside(self, source: str) -> bool:
        return self._nodes is not None and source not in self._nodes


__all__ = ["FlightLog", "read_log"]
