"""MAVLink over a serial line (UART or USB), alone on it."""

from __future__ import annotations

import contextlib
import errno
import os
from typing import Final

import serial

from companion.core.errors import LinkError
from companion.runtime.ports.endpoint import Endpoint
from companion.runtime.ports.port import READ_BYTES, Outbox, Report, Traffic

_HELD: Final = (errno.EAGAIN, errno.EWOULDBLOCK, errno.EBUSY)


class SerialPort:
    """A serial device; unplugged, it is looked for again."""

    def __init__(self, endpoint: Endpoint, traffic: Traffic, *, report: Report) -> None:
        self._endpoint, self._traffic, self._report = endpoint, traffic, report
        self._line: serial.Serial | None = None
        self._outbox = Outbox()

    def open(self) -> None:
        """Open and lock; OSError while the device is not there."""
        path = self._endpoint.path
        try:
            self._line = serial.Serial(path, self._endpoint.baud, timeout=0, write_timeout=0, exclusive=True)
        except serial.SerialException as error:
            if error.errno in _HELD:
                raise LinkError(f"another program uses {path}; stop it") from error
            if error.errno == errno.EACCES:
                raise LinkError(f"no permission to use {path}; add yourself to its group (dialout)") from error
            raise OSError(error.errno or errno.EIO, f"{path}: {_reason(error)}") from error
        except ValueError as error:
            raise LinkError(f"{path} does not do {self._endpoint.baud} baud: {error}") from error

    def descriptors(self) -> list[int]:
        """The device."""
        return [self._line.fileno()] if self._line else []

    def writes(self) -> list[int]:
        """The device, while frames wait."""
        return self.descriptors() if self._outbox.waiting else []

    def read(self) -> list[bytes]:
        """What has come; a device that is ready and has nothing is gone."""
        assert self._line is not None
        try:
            data = os.read(self._line.fileno(), READ_BYTES)
        except BlockingIOError:
            return []
        if not data:
            raise ConnectionResetError(f"{self._endpoint.path} is gone")
        return [data]

    def write(self, data: bytes) -> None:
        """Write now what fits, keep the rest."""
        if self._line is None:
            self._traffic.dropped += 1
            return
        self._traffic.dropped += self._outbox.push(data)
        self.flush()

    def flush(self) -> None:
        """Write what waits; the reader finds out why if that fails."""
        if self._line is not None:
            descriptor = self._line.fileno()
            with contextlib.suppress(OSError):
                self._outbox.flush(lambda data: os.write(descriptor, data), self._traffic)

    def close(self) -> None:
        """Close the device."""
        if self._line is not None:
            with contextlib.suppress(OSError, serial.SerialException):
                self._line.close()
        self._line = None
        self._traffic.dropped += self._outbox.clear()

    @property
    def connected(self) -> bool:
        """The device is open; whether somebody speaks there, only the data tell."""
        return self._line is not None

    @property
    def peer(self) -> str:
        """The device."""
        return self._endpoint.path if self._line else ""


def _reason(error: serial.SerialException) -> str:
    return os.strerror(error.errno) if error.errno else str(error)
