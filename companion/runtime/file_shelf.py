"""Bytes of the map that RAM is too dear for, in an unnamed temporary file."""

from __future__ import annotations

import os
import tempfile
import weakref
import zlib
from dataclasses import dataclass
from pathlib import Path

_PAGE = 4096
_ON_DISK = Path("/var/tmp")  # where systems keep large temporary files; /tmp is memory on many


@dataclass(frozen=True, slots=True)
class _Place:
    first: int  # byte of the file
    size: int
    check: int  # CRC-32


class FileShelf:
    """Keeps bytes in a file in `folder`, which has no name and is gone with the process.

    >>> shelf = FileShelf()
    >>> number = shelf.put(b"...")
    >>> shelf.get(number)

    The file is made by the first `put`. What is dropped leaves a gap, which the next bytes of as
    many pages fill. All methods raise OSError when the file system does, or gives back other bytes.
    """

    def __init__(self, folder: Path | None = None) -> None:
        self.folder = folder or (_ON_DISK if os.access(_ON_DISK, os.W_OK) else Path(tempfile.gettempdir()))
        self.file_bytes = 0  # gaps included
        self._file: int | None = None
        self._places: dict[int, _Place] = {}
        self._gaps: dict[int, list[int]] = {}  # by their size in pages: where they begin
        self._next = 0

    def put(self, data: bytes) -> int:
        """Keep the bytes; returns the number by which they are found."""
        if self._file is None:
            self._file = _unnamed(self.folder)
            weakref.finalize(self, os.close, self._file)
        place = _Place(self._room(_pages(len(data))), len(data), zlib.crc32(data))
        try:
            _write(self._file, data, place.first)
        except OSError:
            self._gaps.setdefault(_pages(place.size), []).append(place.first)
            raise
        self._next += 1
        self._places[self._next] = place
        return self._next

    def get(self, number: int) -> bytes:
        """The bytes that `put` was given."""
        place = self._places[number]
        assert self._file is not None
        data = _read(self._file, place.first, place.size)
        if zlib.crc32(data) != place.check:
            raise OSError(f"bytes at {place.first} of the temporary file in {self.folder} are damaged")
        return data

    def drop(self, number: int) -> None:
        """The bytes are not needed any more."""
        place = self._places.pop(number)
        self._gaps.setdefault(_pages(place.size), []).append(place.first)

    def _room(self, pages: int) -> int:
        """Where so many pages are free: a gap, or the end."""
        gaps = self._gaps.get(pages)
        if gaps:
            return gaps.pop()
        first = self.file_bytes
        self.file_bytes += pages * _PAGE
        return first


def _pages(size: int) -> int:
    """Whole ones, in steps of an eighth: few sizes, so that gaps are soon filled."""
    pages = max(-(-size // _PAGE), 1)
    step = max(1 << pages.bit_length() - 4, 1) if pages >= 16 else 1
    return -(-pages // step) * step


def _unnamed(folder: Path) -> int:
    with tempfile.TemporaryFile(dir=folder, buffering=0) as file:
        return os.dup(file.fileno())


def _write(file: int, data: bytes, first: int) -> None:
    view = memoryview(data)
    while view:
        done = os.pwrite(file, view, first)
        view, first = view[done:], first + done


def _read(file: int, first: int, size: int) -> bytes:
    parts: list[bytes] = []
    while size > 0:
        part = os.pread(file, size, first)
        if not part:
            raise OSError("the temporary file ends too early")
        parts.append(part)
        first, size = first + len(part), size - len(part)
    return b"".join(parts)
