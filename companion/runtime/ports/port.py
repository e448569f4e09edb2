"""What every way to carry bytes has in common."""

from __future__ import annotations

import errno
import socket
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Final, Protocol

from companion.core.errors import LinkError

READ_BYTES: Final = 65536
PENDING_BYTES: Final = 4096  # 44 ms of a line of 921600 baud: older demands are worth nothing
Report = Callable[[str], None]
Clock = Callable[[], int]


@dataclass(slots=True)
class Traffic:
    """Counts of one link since it was opened."""

    bytes_in: int = 0
    datagrams_in: int = 0  # or pieces read from a stream
    bytes_out: int = 0
    datagrams_out: int = 0
    dropped: int = 0  # sends that never left
    foreign: int = 0  # datagrams or clients turned away


class Port(Protocol):
    """One way to carry bytes. OSError: it ended, try again; LinkError: trying again is no use."""

    def open(self) -> None:
        """Bind, connect or open, within about a second."""
        ...

    def descriptors(self) -> list[int]:
        """What to wait on for reading."""
        ...

    def writes(self) -> list[int]:
        """What to wait on for writing, since something is left to write."""
        ...

    def read(self) -> list[bytes]:
        """What is there now, or a part of it; never waits."""
        ...

    def write(self, data: bytes) -> None:
        """Hand one frame over, or count it as dropped; never waits."""
        ...

    def flush(self) -> None:
        """Write what is left."""
        ...

    def close(self) -> None:
        """Let go; may be called twice."""
        ...

    @property
    def connected(self) -> bool:
        """Somebody is there."""
        ...

    @property
    def peer(self) -> str:
        """Who is there, or ''."""
        ...


@dataclass(slots=True)
class Outbox:
    """Frames that wait for a slow stream. When they are too many the oldest goes: newest counts."""

    limit: int = PENDING_BYTES
    waiting: deque[bytes] = field(default_factory=deque)
    size: int = 0
    begun: bool = False  # a part of the first is out already: the rest must follow

    def push(self, data: bytes) -> int:
        """Add a frame; returns how many others were dropped for it."""
        self.waiting.append(data)
        self.size += len(data)
        dropped, first = 0, int(self.begun)
        while self.size > self.limit and len(self.waiting) > first + 1:
            self.size -= len(self.waiting[first])
            del self.waiting[first]
            dropped += 1
        return dropped

    def flush(self, write: Callable[[bytes], int], traffic: Traffic) -> None:
        """Write until it is empty or `write` raises BlockingIOError or takes nothing."""
        while self.waiting:
            first = self.waiting[0]
            try:
                taken = write(first)
            except BlockingIOError:
                return
            traffic.bytes_out += taken
            self.size -= taken
            if taken == len(first):
                self.waiting.popleft()
                self.begun = False
                traffic.datagrams_out += 1
            elif taken:
                self.waiting[0] = first[taken:]
                self.begun = True
            else:
                return

    def clear(self) -> int:
        """Forget everything; returns how many frames that were."""
        lost = len(self.waiting)
        self.waiting.clear()
        self.size, self.begun = 0, False
        return lost


def resolve(host: str, port: int, kind: socket.SocketKind) -> tuple[socket.AddressFamily, tuple[str, int]]:
    """The address of a host, IPv4 before IPv6, so that `localhost` is the same on both sides."""
    found = socket.getaddrinfo(host, port, type=kind)
    found.sort(key=lambda entry: entry[0] != socket.AF_INET)
    return found[0][0], found[0][4]  # type: ignore[return-value]


def bound(sock: socket.socket, address: tuple[str, int], url: str) -> None:
    """Bind, or raise LinkError that says what to do."""
    try:
        sock.bind(address)
    except OSError as error:
        raise cannot_listen(url, error) from error


def cannot_listen(url: str, error: OSError) -> LinkError:
    """The sentence for an address that cannot be had."""
    if error.errno == errno.EADDRINUSE:
        return LinkError(f"another companion or ground station listens on {url}; stop it, or take another port")
    if error.errno == errno.EADDRNOTAVAIL:
        return LinkError(f"{url}: this machine has no such address; use one of its own, or 0.0.0.0")
    return LinkError(f"cannot listen on {url}: {error.strerror or error}")


def shown(address: tuple[str, int]) -> str:
    """host:port, IPv6 in brackets."""
    host = f"[{address[0]}]" if ":" in address[0] else address[0]
    return f"{host}:{address[1]}"
