"""Writes what it is given into MCAP files on a thread of its own; whoever gives never waits.

    recorder = Recorder(folder / "flight.mcap")
    recorder.put(sample)  # from any thread, such as a bus callback
    recorder.close()

Every second what was heard is on its way to the disk: a recorder that is killed loses no more than
that (`companion.runtime.mcap_file.recover`).
"""

from __future__ import annotations

import time
from collections import Counter, deque
from pathlib import Path
from threading import Condition, Thread

from companion.runtime.mcap_file import McapFile, Sample

FLUSH_S = 1.0
WAITING_BYTES = 128 << 20  # about 8 s of everything that the stack says
_OVERHEAD = 64  # of a message, so that empty ones count


class Recorder:
    """One recording; `split_bytes` or `split_s` start a new file beyond (0: never)."""

    def __init__(
        self, path: Path, *, split_bytes: int = 0, split_s: float = 0.0, waiting_bytes: int = WAITING_BYTES
    ) -> None:
        self.files: list[Path] = []
        self.written: Counter[str] = Counter()  # per topic
        self.dropped: Counter[str] = Counter()  # per topic: the disk was too slow
        self.failure = ""  # why it stopped, '' if it did not
        self._path, self._split_bytes, self._split_s = path, split_bytes, split_s
        self._limit, self._held = waiting_bytes, 0
        self._waiting: deque[Sample] = deque()
        self._changed = Condition()
        self._closing = False
        self._file = self._next_file()
        self._file_s = time.monotonic()
        self._thread = Thread(target=self._run, name="recorder", daemon=True)
        self._thread.start()

    def put(self, sample: Sample) -> bool:
        """Hand over a message; False if it was dropped since too much waits for the disk."""
        size = len(sample.payload) + _OVERHEAD
        with self._changed:
            if self.failure or self._closing or self._held + size > self._limit:
                self.dropped[sample.topic] += 1
                return False
            self._waiting.append(sample)
            self._held += size
            self._changed.notify()
        return True

    def close(self) -> None:
        """Write what waits and end the file."""
        with self._changed:
            self._closing = True
            self._changed.notify()
        self._thread.join()

    def _run(self) -> None:
        try:
            self._record()
        except OSError as error:
            self.failure = f"cannot be written: {error}"

    def _record(self) -> None:
        flushed_s = time.monotonic()
        while True:
            batch, closing = self._take()
            for sample in batch:
                self._file.write(sample)
                self.written[sample.topic] += 1
            if closing and not batch:
                break
            if time.monotonic() - flushed_s >= FLUSH_S:
                self._file.flush()
                flushed_s = time.monotonic()
                self._split()
        self._file.close()

    def _take(self) -> tuple[list[Sample], bool]:
        with self._changed:
            if not self._waiting and not self._closing:
                self._changed.wait(FLUSH_S)
            batch = list(self._waiting)
            self._waiting.clear()
            self._held = 0
            return batch, self._closing

    def _split(self) -> None:
        too_large = self._split_bytes and self._file.bytes >= self._split_bytes
        too_long = self._split_s and time.monotonic() - self._file_s >= self._split_s
        if (too_large or too_long) and self._file.messages:
            self._file.close()
            self._file, self._file_s = self._next_file(), time.monotonic()

    def _next_file(self) -> McapFile:
        number = len(self.files)
        path = self._path.with_stem(f"{self._path.stem}_{number}") if number else self._path
        self.files.append(path)
        return McapFile(path)
