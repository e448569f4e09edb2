"""The log of one live process: what goes into each node and what comes out, written by all its threads.

A node's thread pays for appending to a list; a thread of the log encodes, digests and writes. A slow
disk therefore delays no node: when too much waits, the log stops and says so, the flight goes on.
"""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from threading import Event, Lock, Thread
from typing import Any

from companion.core.node import Topic
from companion.runtime.codec import summed
from companion.runtime.log_file import Header, LogFile, Store

OUTSIDE = "outside"  # the source of what came over the bus or the link
PERIOD_S = 0.1  # a killed process loses what it logged for so long
WAITING_LIMIT = 40_000  # entries, about 10 s of the busiest group
BULK_LIMIT = 60  # messages of bulk topics that wait: they hold the memory

_Waiting = tuple[int, str, str, Topic[Any] | None, Any]  # time, source or node, event, topic, message or number


class InboxLog:
    """Thread-safe log of a group; `failure` says why it stopped before its end, '' if it did not."""

    def __init__(self, path: Path, header: Header, *, store: Store = "recorded") -> None:
        self.failure = ""
        self._store: Store = store
        self._file = LogFile(path)
        self._file.header(header)
        self._lock, self._closing = Lock(), Event()
        self._waiting: list[_Waiting] = []
        self._bulk = 0
        self._number = -1
        self._newest_ns = 0
        self._thread = Thread(target=self._run, name="inbox log", daemon=True)
        self._thread.start()

    def received(self, now_ns: int, topic: Topic[Any], message: Any) -> int:
        """Take note of a message from outside the process, in full; returns its number."""
        return self._add((now_ns, OUTSIDE, topic.name, topic, message))

    def published(self, now_ns: int, source: str, topic: Topic[Any], message: Any) -> int:
        """Take note of a message of a node of this process; returns its number."""
        return self._add((now_ns, source, topic.name, topic, message))

    def fed(self, now_ns: int, node: str, event: str, number: int) -> None:
        """A node gets message `number`, or a tick (number -1); call it right before the node does."""
        self._add((now_ns, node, event, None, number))

    def close(self) -> None:
        """Write what waits and close the file."""
        self._closing.set()
        self._thread.join()

    def _add(self, entry: _Waiting) -> int:
        topic = entry[3]
        with self._lock:
            if topic is not None:
                self._number += 1
            if not self.failure:
                self._waiting.append(entry)
                self._bulk += topic is not None and topic.service == "bulk"
                if len(self._waiting) > WAITING_LIMIT or self._bulk > BULK_LIMIT:
                    self.failure = f"the disk was too slow: {len(self._waiting)} entries waited"
            return self._number

    def _run(self) -> None:
        try:
            while not self._closing.wait(PERIOD_S):
                self._drain()
            self._drain()
            self._file.end(self._newest_ns, self.failure)
            self._file.close()
        except Exception as error:  # whatever it is: a log must not end a flight
            self.failure = f"cannot be written: {type(error).__name__}: {error}"
            with self._lock:
                self._waiting.clear()
            with suppress(OSError):
                self._file.close()

    def _drain(self) -> None:
        with self._lock:
            waiting, self._waiting, self._bulk = self._waiting, [], 0
        for time_ns, source, event, topic, value in waiting:
            if topic is None:
                self._file.fed(time_ns, source, event, value)
            else:
                self._message(time_ns, source, topic, value)
            self._newest_ns = time_ns
        self._file.flush()

    def _message(self, time_ns: int, source: str, topic: Topic[Any], message: Any) -> None:
        stored = source == OUTSIDE or self._store == "all" or (self._store == "recorded" and topic.recorded)
        data, digest, _ = summed(message, stored=stored)
        self._file.message(time_ns, source, topic.name, data, digest)


def inbox_path(folder: Path, group: str) -> Path:
    """`inbox-<group>.log`, or `inbox-<group>-2.log` and so on after a restart: a replay needs fresh nodes."""
    path, restart = folder / f"inbox-{group}.log", 2
    while path.exists():
        path, restart = folder / f"inbox-{group}-{restart}.log", restart + 1
    return path
