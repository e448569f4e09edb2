"""MAVLink over TCP: connecting, or listening for one client."""

from __future__ import annotations

import contextlib
import socket
from typing import Final

from companion.core.errors import LinkError
from companion.runtime.ports.endpoint import Endpoint
from companion.runtime.ports.port import (
    PENDING_BYTES,
    READ_BYTES,
    Outbox,
    Report,
    Traffic,
    bound,
    cannot_listen,
    resolve,
    shown,
)

CONNECT_S: Final = 1.0
DEAD_MS: Final = 5000  # without an acknowledgement for so long the peer is gone
# TCP_NOTSENT_LOWAT keeps the kernel from hoarding: what waits is ours to replace by newer frames.
OPTIONS: Final = (
    ("TCP_NODELAY", 1),
    ("TCP_KEEPIDLE", 2),
    ("TCP_KEEPINTVL", 1),
    ("TCP_USER_TIMEOUT", DEAD_MS),
    ("TCP_NOTSENT_LOWAT", PENDING_BYTES),
)


class TcpPort:
    """A TCP connection; `tcpin` listens, serves one client and turns others away."""

    def __init__(self, endpoint: Endpoint, traffic: Traffic, *, report: Report) -> None:
        self._endpoint, self._traffic, self._report = endpoint, traffic, report
        self._listens = endpoint.kind == "tcpin"
        self._listener: socket.socket | None = None
        self._client: socket.socket | None = None
        self._peer = ""
        self._outbox = Outbox()

    def open(self) -> None:
        """Connect, or listen (LinkError if that address cannot be had)."""
        try:
            family, address = resolve(self._endpoint.host, self._endpoint.port, socket.SOCK_STREAM)
        except OSError as error:
            raise (cannot_listen(str(self._endpoint), error) if self._listens else error) from error
        sock = socket.socket(family, socket.SOCK_STREAM)
        try:
            if self._listens:
                sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                bound(sock, address, str(self._endpoint))
                sock.listen(4)
                sock.setblocking(False)
                self._listener = sock
            else:
                sock.settimeout(CONNECT_S)
                sock.connect(address)
                self._begin(sock, address)
        except (OSError, LinkError):
            sock.close()
            raise

    def _begin(self, sock: socket.socket, address: tuple[str, int]) -> None:
        sock.setblocking(False)
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        for option, value in OPTIONS:
            if hasattr(socket, option):  # not every system has all of them
                sock.setsockopt(socket.IPPROTO_TCP, getattr(socket, option), value)
        self._client, self._peer = sock, shown(address)

    def descriptors(self) -> list[int]:
        """Listener and client."""
        return [s.fileno() for s in (self._listener, self._client) if s is not None]

    def writes(self) -> list[int]:
        """The client, while frames wait."""
        return [self._client.fileno()] if self._client is not None and self._outbox.waiting else []

    def read(self) -> list[bytes]:
        """What the peer sent; a client that left makes room for another."""
        if self._listener is not None:
            self._take_clients(self._listener)
        if self._client is None:
            return []
        try:
            data = self._client.recv(READ_BYTES)
        except BlockingIOError:
            return []
        except OSError:
            data = b""
        if data:
            return [data]
        self._lose_client()
        return []

    def _take_clients(self, listener: socket.socket) -> None:
        with contextlib.suppress(BlockingIOError):
            while True:
                sock, address = listener.accept()
                if self._client is None:
                    self._begin(sock, address)
                    self._report(f"{self._endpoint}: talking with {self._peer}")
                else:
                    sock.close()
                    self._traffic.foreign += 1
                    self._report(f"{self._endpoint}: {shown(address)} turned away; the link belongs to {self._peer}")

    def _lose_client(self) -> None:
        """Without a listener there is nothing left: ConnectionError."""
        if not self._listens:
            raise ConnectionResetError(f"{self._peer} closed the connection")
        self._report(f"{self._endpoint}: {self._peer} left")
        self._drop_client()

    def _drop_client(self) -> None:
        if self._client is not None:
            with contextlib.suppress(OSError):
                self._client.close()
        self._client, self._peer = None, ""
        self._traffic.dropped += self._outbox.clear()

    def write(self, data: bytes) -> None:
        """Send now what fits, keep the rest."""
        if self._client is None:
            self._traffic.dropped += 1
            return
        self._traffic.dropped += self._outbox.push(data)
        self.flush()

    def flush(self) -> None:
        """Send what waits; the reader finds out why if that fails."""
        if self._client is not None:
            with contextlib.suppress(OSError):
                self._outbox.flush(self._client.send, self._traffic)

    def close(self) -> None:
        """Close everything."""
        self._drop_client()
        if self._listener is not None:
            self._listener.close()
        self._listener = None

    @property
    def connected(self) -> bool:
        """A connection stands."""
        return self._client is not None

    @property
    def peer(self) -> str:
        """host:port of the peer."""
        return self._peer
