"""The renderer in a process of its own, with results in shared memory."""

from __future__ import annotations

import dataclasses
import math
import multiprocessing
import signal
import traceback
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing.connection import Connection
from multiprocessing.shared_memory import SharedMemory
from typing import Any, cast

import numpy as np

from companion.core.messages import CameraImage, LidarScan, freeze
from sim.sensors.scene import RenderSetup, Sensors

Header = list[tuple[str, Any]]  # field -> value, or (dtype, shape) of an array in the slot
_SLOTS = 16  # results that may wait to be fetched
_KINDS: dict[str, type[LidarScan] | type[CameraImage]] = {"lidar": LidarScan, "camera": CameraImage}


class RenderError(RuntimeError):
    """The worker failed or died; the text is its own traceback."""


@dataclass
class _Job:
    """A promised message."""

    kind: str
    fetch: Callable[..., None]
    slot: int
    value: Any = None
    error: str = ""

    def result(self) -> Any:
        """Wait for the message; raises RenderError."""
        if self.value is None and not self.error:
            self.fetch(self)
        if self.error:
            raise RenderError(self.error)
        return self.value

    def ready(self) -> bool:
        """Whether `result` would not wait."""
        if self.value is None and not self.error:
            self.fetch(self, wait=False)
        return self.value is not None or bool(self.error)


class Worker:
    """The parent's end: sends requests, hands out results in any order asked for."""

    def __init__(self, setup: RenderSetup, cpu_s: dict[str, float]) -> None:
        context = multiprocessing.get_context("spawn")
        self._cpu_s = cpu_s  # added to
        self._slot_bytes = setup.message_bytes
        self._shared = SharedMemory(create=True, size=_SLOTS * self._slot_bytes)
        self._buffer = cast(memoryview, self._shared.buf)
        self._conn, theirs = context.Pipe()
        arguments = (setup, theirs, self._shared.name, self._slot_bytes)
        self._process = context.Process(target=serve, args=arguments, daemon=True, name="understory-render")
        self._process.start()
        theirs.close()
        self._free = deque(range(_SLOTS))
        self._waiting: deque[_Job] = deque()
        self._ready = False
        self._closed = False

    def wait_ready(self) -> None:
        """Block until the worker has built and compiled everything; raises RenderError."""
        if not self._ready:
            if error := self._receive():
                raise RenderError(error)
            self._ready = True

    def waiting(self) -> int:
        """Requests without a result so far."""
        if self._waiting:
            self._fetch(self._waiting[-1], wait=False)
        return len(self._waiting)

    def submit(self, kind: str, request: dict[str, Any]) -> _Job:
        """Queue a request; waits only if all slots are taken by results that nobody fetched."""
        if self._closed:
            raise RenderError("the renderer was closed")
        while not self._free:
            self._fetch(self._waiting[0])
        job = _Job(kind, self._fetch, self._free.popleft())
        self._waiting.append(job)
        try:
            self._conn.send((kind, job.slot, request))
        except OSError:
            self._fetch(job)
        return job

    def close(self) -> None:
        """End the worker and free the memory; jobs that still wait fail."""
        if self._closed:
            return
        self._closed = True
        self._fail_all("the renderer was closed")
        self._conn.close()
        self._process.join(timeout=5.0)
        if self._process.is_alive():
            self._process.terminate()
            self._process.join()
        self._shared.close()
        self._shared.unlink()

    def _fetch(self, job: _Job, *, wait: bool = True) -> None:
        """Take results, in order, until `job` has its own, or until there are no more."""
        try:
            self.wait_ready()
            while job.value is None and not job.error and (wait or self._conn.poll()):
                self._hand_out(self._receive())
        except (RenderError, OSError) as error:
            self._fail_all(str(error))

    def _hand_out(self, answer: Any) -> None:
        """An answer is the result of the oldest request."""
        done = self._waiting.popleft()
        self._free.append(done.slot)
        if isinstance(answer, str):
            done.error = answer
            return
        header, cpu_s = answer
        self._cpu_s[done.kind] += cpu_s
        done.value = _read(done.kind, header, self._buffer, done.slot * self._slot_bytes)

    def _receive(self) -> Any:
        try:
            return self._conn.recv()
        except (EOFError, OSError):
            self._process.join(timeout=1.0)
            raise RenderError(f"the render worker died, exit code {self._process.exitcode}") from None

    def _fail_all(self, reason: str) -> None:
        for job in self._waiting:
            job.error = reason
        self._waiting.clear()


def serve(setup: RenderSetup, conn: Connection, shared_name: str, slot_bytes: int) -> None:
    """The worker's life: say ready, answer requests in order, end with the parent."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent ends us
    shared = SharedMemory(shared_name)
    buffer = cast(memoryview, shared.buf)
    try:
        sensors = _built(setup, conn)
        while sensors and (request := _next(conn)):
            kind, slot, arguments = request
            try:
                message, cpu_s = sensors.render(kind, arguments)
                conn.send((_write(message, buffer, slot * slot_bytes), cpu_s))
            except OSError:
                break  # nobody listens any more
            except Exception:
                conn.send(traceback.format_exc())
    finally:
        shared.close()


def _built(setup: RenderSetup, conn: Connection) -> Sensors | None:
    try:
        sensors = Sensors(setup)
        sensors.warm()
        conn.send("")
        return sensors
    except Exception:
        conn.send(traceback.format_exc())
        return None


def _next(conn: Connection) -> tuple[str, int, dict[str, Any]] | None:
    parent = multiprocessing.parent_process()
    while not conn.poll(1.0):
        if parent is None or not parent.is_alive():
            return None
    try:
        return cast(tuple[str, int, dict[str, Any]], conn.recv())
    except (EOFError, OSError):
        return None


def _write(message: LidarScan | CameraImage, shared: memoryview, at: int) -> Header:
    """Arrays one behind the other from byte `at`; the rest into the header."""
    header: Header = []
    for field in dataclasses.fields(message):
        value = getattr(message, field.name)
        if isinstance(value, np.ndarray):
            np.frombuffer(shared, value.dtype, value.size, at)[:] = value.ravel()
            at += value.nbytes
            value = (value.dtype.str, value.shape)
        header.append((field.name, value))
    return header


def _read(kind: str, header: Header, shared: memoryview, at: int) -> Any:
    """The message, with its own copies of the arrays."""
    fields: dict[str, Any] = {}
    for name, value in header:
        if isinstance(value, tuple):
            dtype, shape = value
            value = np.frombuffer(shared, dtype, math.prod(shape), at).reshape(shape).copy()
            at += value.nbytes
        fields[name] = value
    return freeze(_KINDS[kind](**fields))
