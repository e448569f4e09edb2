"""Where the bytes of cold regions lie: on a shelf that someone gives, or in memory."""

from __future__ import annotations

from typing import Protocol


class Shelf(Protocol):
    """Keeps bytes outside of memory, as `companion.runtime.file_shelf` does."""

    def put(self, data: bytes) -> int:
        """Keep the bytes; returns a number, not negative, by which they are found. Raises OSError: not kept."""
        ...

    def get(self, number: int) -> bytes:
        """The bytes that `put` was given. Raises OSError: they cannot be read, or are not the same any more."""
        ...

    def drop(self, number: int) -> None:
        """The bytes are not needed any more."""
        ...


class Shelves:
    """A shelf, and memory from the moment on in which that refuses: nothing is lost by it.

    `refusal` says why it did; None: it did not. `outside_bytes` lie there, `inside_bytes` in memory.
    """

    def __init__(self, outside: Shelf | None) -> None:
        self.refusal: str | None = None
        self.outside_bytes = self.inside_bytes = 0
        self._outside = outside
        self._inside: dict[int, bytes] = {}
        self._sizes: dict[int, int] = {}  # of what lies outside
        self._next = -1  # numbers of the inside are negative

    def put(self, data: bytes) -> int:
        """Keep the bytes; returns the number by which they are found."""
        if self._outside is not None and self.refusal is None:
            try:
                number = self._outside.put(data)
            except OSError as error:
                self.refusal = str(error)
            else:
                self._sizes[number] = len(data)
                self.outside_bytes += len(data)
                return number
        self._next -= 1
        self._inside[self._next] = data
        self.inside_bytes += len(data)
        return self._next

    def get(self, number: int) -> bytes:
        """The bytes that `put` was given. Raises OSError, from outside alone."""
        if number < 0 or self._outside is None:
            return self._inside[number]
        return self._outside.get(number)

    def drop(self, number: int) -> None:
        """The bytes are not needed any more."""
        if number < 0 or self._outside is None:
            self.inside_bytes -= len(self._inside.pop(number))
        else:
            self._outside.drop(number)
            self.outside_bytes -= self._sizes.pop(number)
