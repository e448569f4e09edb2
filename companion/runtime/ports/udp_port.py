"""MAVLink over UDP: one datagram is one piece.

Listening, the port answers whoever spoke MAVLink to it first, as long as that peer speaks; a
second speaker is told of and not followed until the first was silent for SILENCE_S.
"""

from __future__ import annotations

import contextlib
import ipaddress
import socket
from typing import Final

from companion.core.errors import LinkError
from companion.runtime.ports.endpoint import Endpoint
from companion.runtime.ports.port import READ_BYTES, Clock, Report, Traffic, bound, cannot_listen, resolve, shown

SILENCE_S: Final = 5.0
BUFFER_BYTES: Final = 1 << 20
STRANGERS_MAX: Final = 16  # told of one by one
MAGICS: Final = (0xFD, 0xFE)


class UdpPort:
    """A UDP socket with one peer: given (udpout) or found (udpin)."""

    def __init__(self, endpoint: Endpoint, traffic: Traffic, *, clock: Clock, report: Report) -> None:
        self._endpoint, self._traffic = endpoint, traffic
        self._clock, self._report = clock, report
        self._sends = endpoint.kind == "udpout"
        self._socket: socket.socket | None = None
        self._peer: tuple[str, int] | None = None
        self._heard_ns: int | None = None
        self._strangers: list[tuple[str, int]] = []

    def open(self) -> None:
        """Bind; a listener that cannot raises LinkError."""
        try:
            family, address = resolve(self._endpoint.host, self._endpoint.port, socket.SOCK_DGRAM)
        except OSError as error:
            raise (error if self._sends else cannot_listen(str(self._endpoint), error)) from error
        sock = socket.socket(family, socket.SOCK_DGRAM)
        try:
            sock.setblocking(False)
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, BUFFER_BYTES)
            if not self._sends:
                bound(sock, address, str(self._endpoint))
            elif ipaddress.ip_address(address[0].partition("%")[0]).is_loopback:
                sock.bind((address[0], 0))  # unbound, it would hear from every network
        except (OSError, LinkError):
            sock.close()
            raise
        self._socket, self._heard_ns = sock, None
        self._peer = address if self._sends else None

    def descriptors(self) -> list[int]:
        """The socket."""
        return [self._socket.fileno()] if self._socket else []

    def writes(self) -> list[int]:
        """Datagrams never wait."""
        return []

    def read(self) -> list[bytes]:
        """One datagram of the peer: asking whether there is a second costs more than waiting for it."""
        assert self._socket is not None
        try:
            data, address = self._socket.recvfrom(READ_BYTES)
        except (BlockingIOError, ConnectionError):  # the latter: an earlier one of ours met a closed port
            return []
        return [data] if data and self._accepts(data, address) else []

    def _accepts(self, data: bytes, address: tuple[str, int]) -> bool:
        now_ns = self._clock()
        if address != self._peer:
            if self._sends or data[0] not in MAGICS:
                self._traffic.foreign += 1
                return False
            if self.connected:
                self._turn_away(address)
                return False
            self._follow(address)
        self._heard_ns = now_ns
        return True

    def _follow(self, address: tuple[str, int]) -> None:
        before, self._peer = self._peer, address
        self._strangers.clear()
        gone = f", since {shown(before)} fell silent" if before else ""
        self._report(f"{self._endpoint}: talking with {shown(address)}{gone}")

    def _turn_away(self, address: tuple[str, int]) -> None:
        self._traffic.foreign += 1
        if address not in self._strangers and len(self._strangers) < STRANGERS_MAX:
            self._strangers.append(address)
            self._report(
                f"{self._endpoint}: {shown(address)} speaks too and is not listened to; "
                f"the link belongs to {self.peer} until it is silent for {SILENCE_S:g} s"
            )

    def write(self, data: bytes) -> None:
        """One datagram to the peer."""
        if self._socket is None or self._peer is None:
            self._traffic.dropped += 1
            return
        try:
            self._traffic.bytes_out += self._socket.sendto(data, self._peer)
            self._traffic.datagrams_out += 1
        except OSError:  # full buffer, no route, too long: the next one may pass
            self._traffic.dropped += 1

    def flush(self) -> None:
        """Nothing ever waits."""

    def close(self) -> None:
        """Close the socket."""
        if self._socket is not None:
            with contextlib.suppress(OSError):
                self._socket.close()
        self._socket = None

    @property
    def connected(self) -> bool:
        """The peer spoke within the last SILENCE_S."""
        return self._heard_ns is not None and self._clock() - self._heard_ns <= SILENCE_S * 1e9

    @property
    def peer(self) -> str:
        """host:port of the peer."""
        return shown(self._peer) if self._peer else ""
