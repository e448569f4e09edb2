"""One MAVLink link: bytes in by a callback, bytes out by `send`, reconnecting by itself.

    link = open_link("udpin://127.0.0.1:14540", received, clock=clock)
    link.send(data)
    link.stats.connected
    link.close()

The link knows nothing of MAVLink but the byte that a frame starts with; frames, signatures and
meaning belong to `companion.autopilot`.
"""

from __future__ import annotations

import contextlib
import select
import socket
import threading
from collections.abc import Callable
from dataclasses import dataclass
from types import TracebackType
from typing import Final

from companion.core.errors import LinkError
from companion.runtime.ports.endpoint import Endpoint, UdpMeans, parse_endpoint
from companion.runtime.ports.port import Clock, Port, Report, Traffic
from companion.runtime.ports.serial_port import SerialPort
from companion.runtime.ports.tcp_port import TcpPort
from companion.runtime.ports.udp_port import UdpPort

BACK_OFF_FIRST_S: Final = 0.2
BACK_OFF_MOST_S: Final = 2.0
JOIN_S: Final = 3.0
Received = Callable[[bytes, int], None]


@dataclass(frozen=True, slots=True)
class LinkStats:
    """How a link fares; counts since it was opened."""

    connected: bool  # TCP: a connection stands; serial: the device is open; UDP: heard within 5 s
    peer: str
    bytes_in: int
    datagrams_in: int  # pieces, on a stream
    bytes_out: int
    datagrams_out: int
    dropped: int  # sends that never left
    foreign: int  # datagrams or clients turned away
    reconnects: int
    trouble: str  # why there is no connection, or ''


def _silent(text: str) -> None:
    """Nobody wants to know."""


def open_link(
    url: str | Endpoint,
    received: Received,
    *,
    clock: Clock,
    udp_means: UdpMeans = "in",
    report: Report = _silent,
) -> Link:
    """Open a link; `received(data, stamp_ns)` and `report(sentence)` are called from its reader thread.

    Neither may do anything slow. `stamp_ns` is `clock()` right after
    the bytes were read.
    Raises InputError for a bad URL and LinkError for what trying again would not mend (address
    in use, device held by others); what comes and goes (a host, a device, a connection) is tried
    again every 0.2 to 2 s and told to `report`.
    """
    endpoint = url if isinstance(url, Endpoint) else parse_endpoint(url, udp_means=udp_means)
    return Link(endpoint, received, clock=clock, report=report)


class Link:
    """See `open_link`. Safe to use from several threads; also a context manager."""

    def __init__(self, endpoint: Endpoint, received: Received, *, clock: Clock, report: Report) -> None:
        self.endpoint = endpoint
        self._received, self._clock, self._report = received, clock, report
        self._traffic = Traffic()
        self._openings, self._trouble = 0, ""
        self._lock = threading.RLock()  # held for calls that never wait; `report` may call `send`
        self._closing = False
        self._polled: tuple[tuple[int, ...], tuple[int, ...]] = (), ()
        self._poll = select.poll()
        self._port = _port(endpoint, self._traffic, clock=clock, report=report)
        self._opened = False
        if endpoint.kind != "tcp":  # the only opening that may take long
            self._try_open()
        self._wake_read, self._wake_write = socket.socketpair()
        self._wake_write.setblocking(False)
        self._thread = threading.Thread(target=self._run, name=f"link {endpoint}", daemon=True)
        self._thread.start()

    def send(self, data: bytes) -> None:
        """Send one frame, or count it as dropped. Never waits, never raises for the network."""
        with self._lock:
            if not self._opened:
                self._traffic.dropped += 1
                return
            self._port.write(data)
            if self._port.writes():
                self._wake()

    def close(self) -> None:
        """Stop the reader and close; may be called twice, and from `received`."""
        self._closing = True
        with self._lock:
            self._wake()
        if threading.current_thread() is not self._thread:
            self._thread.join(JOIN_S)
        with self._lock:
            self._opened = False
            self._port.close()
            self._wake_read.close()
            self._wake_write.close()

    def __enter__(self) -> Link:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.close()

    @property
    def stats(self) -> LinkStats:
        """A snapshot."""
        t = self._traffic
        with self._lock:
            return LinkStats(
                connected=self._opened and self._port.connected,
                peer=self._port.peer,
                bytes_in=t.bytes_in,
                datagrams_in=t.datagrams_in,
                bytes_out=t.bytes_out,
                datagrams_out=t.datagrams_out,
                dropped=t.dropped,
                foreign=t.foreign,
                reconnects=max(0, self._openings - 1),
                trouble=self._trouble,
            )

    # --- the reader thread -------------------------------------------------------------

    def _run(self) -> None:
        try:
            self._loop()
        except Exception as error:  # of `received` or `report`: the owner's fault, and the end
            self._trouble = f"{self.endpoint}: the receiver of the bytes failed: {error!r}"
            raise

    def _loop(self) -> None:
        back_off_s = BACK_OFF_FIRST_S
        while not self._closing:
            pieces = self._next()
            if pieces is None:
                self._pause(back_off_s)
                back_off_s = min(2 * back_off_s, BACK_OFF_MOST_S)
            elif pieces:
                back_off_s = BACK_OFF_FIRST_S
                self._deliver(pieces)

    def _next(self) -> list[bytes] | None:
        """What came, maybe nothing; None if there is no connection."""
        if not self._opened and not self._reopen():
            return None
        try:
            return self._serve()
        except (OSError, ValueError) as error:  # ValueError: the descriptor is gone
            self._lose(error)
            return None

    def _serve(self) -> list[bytes]:
        """Wait for the port or for a call; write what waits, read what is there."""
        wake = self._wake_read.fileno()
        with self._lock:
            poll = self._poll_of((wake, *self._port.descriptors()), tuple(self._port.writes()))
        events = 0
        for descriptor, event in poll.poll():
            if descriptor == wake:
                self._wake_read.recv(4096)
            else:
                events |= event
        with self._lock:
            if events & select.POLLOUT:
                self._port.flush()
            return self._port.read() if events & ~select.POLLOUT else []

    def _poll_of(self, reads: tuple[int, ...], writes: tuple[int, ...]) -> select.poll:
        """Made anew only when something changed: this runs once per datagram."""
        if (reads, writes) != self._polled:
            self._polled, self._poll = (reads, writes), select.poll()
            for descriptor in reads:
                self._poll.register(descriptor, select.POLLIN)
            for descriptor in writes:
                self._poll.register(descriptor, select.POLLIN | select.POLLOUT)
        return self._poll

    def _deliver(self, pieces: list[bytes]) -> None:
        stamp_ns = self._clock()
        self._traffic.bytes_in += sum(map(len, pieces))
        self._traffic.datagrams_in += len(pieces)
        for data in pieces:
            self._received(data, stamp_ns)

    def _try_open(self) -> None:
        """Open once; LinkError goes up, OSError is kept as the trouble."""
        try:
            self._port.open()
        except OSError as error:
            self._note(error)
            return
        except LinkError:
            self._port.close()
            raise
        self._opened, self._openings, self._trouble = True, 1, ""

    def _reopen(self) -> bool:
        """Open again; what would end the program at the start is trouble like any other now."""
        try:
            self._port.open()
        except (OSError, LinkError) as error:
            self._note(error)
            return False
        with self._lock:
            if self._closing:
                self._port.close()
                return False
            self._opened, self._trouble = True, ""
            self._openings += 1
        if self._port.connected:
            self._report(f"{self.endpoint}: connected")
        return True

    def _lose(self, error: Exception) -> None:
        with self._lock:
            self._opened = False
            self._port.close()
        if not self._closing:
            self._note(error)

    def _note(self, error: Exception) -> None:
        text = f"{self.endpoint}: {_sentence(error)}; trying again"
        if text != self._trouble:
            self._trouble = text
            self._report(text)

    def _pause(self, seconds: float) -> None:
        """Wait, unless the link is being closed."""
        if not self._closing and select.select([self._wake_read.fileno()], [], [], seconds)[0]:
            self._wake_read.recv(4096)

    def _wake(self) -> None:
        with contextlib.suppress(OSError):
            self._wake_write.send(b"\0")


def _port(endpoint: Endpoint, traffic: Traffic, *, clock: Clock, report: Report) -> Port:
    if endpoint.kind in ("udpin", "udpout"):
        return UdpPort(endpoint, traffic, clock=clock, report=report)
    if endpoint.kind == "serial":
        return SerialPort(endpoint, traffic, report=report)
    return TcpPort(endpoint, traffic, report=report)


def _sentence(error: Exception) -> str:
    return error.strerror if isinstance(error, OSError) and error.strerror else str(error)
