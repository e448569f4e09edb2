"""The renderer in a process of its own, with results in shared memory."""

from __future__ import annotations

import multiprocessing
import signal
import traceback
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing.connection import Connection
from multiprocessing.shared_memory import SharedMemory
from types import TracebackType
from typing import Any, Generic, Self, TypeVar, cast

import numpy as np

from companion.core.messages import Array, CameraImage, LidarScan, freeze
from sim.sensors.render import RenderSetup, Sensors

M = TypeVar("M")
Header = list[tuple[str, Any]]  # field -> value, or (dtype, shape) of an array in the slot
_SLOTS = 8  # results that may wait to be fetched
_KINDS: dict[str, type[LidarScan] | type[CameraImage]] = {"lidar": LidarScan, "camera": CameraImage}


class RenderError(RuntimeError):
    """The worker failed or died; the text is its own traceback."""


@dataclass
class _Job(Generic[M]):
    """A promised message."""

    kind: str
    fetch: Callable[[_Job[Any]], None]
    slot: int
    value: M | None = None
    error: str = ""

    def result(self) -> M:
        """Wait for the message; raises RenderError."""
        if self.value is None and not self.error:
            self.fetch(self)
        if self.error:
            raise RenderError(self.error)
        return cast(M, self.value)


class WorkerRenderer:
    """Renders in a spawned process: `submit_*` returns at once, `result` waits.

    A script that uses it must guard its entry with `if __name__ == "__main__"`, as every
    spawned process demands. Requests are served in order. The worker ends by itself when
    its parent is gone.
    """

    def __init__(self, setup: RenderSetup) -> None:
        context = multiprocessing.get_context("spawn")
        self._slot_bytes = setup.message_bytes
        self._shared = SharedMemory(create=True, size=_SLOTS * self._slot_bytes)
        self._conn, theirs = context.Pipe()
        arguments = (setup, theirs, self._shared.name, self._slot_bytes)
        self._process = context.Process(target=serve, args=arguments, daemon=True, name="understory-render")
        self._process.start()
        theirs.close()
        self._free = deque(range(_SLOTS))
        self._waiting: deque[_Job[Any]] = deque()
        self._ready = False
        self._closed = False

    def wait_ready(self) -> None:
        """Block until the worker has built and compiled everything; raises RenderError."""
        if not self._ready:
            if error := self._receive():
                raise RenderError(error)
            self._ready = True

    def submit_lidar(
        self, p_world: Array, q_world_body: Array, *, stamp_ns: int, counter: int, **faults: float
    ) -> _Job[LidarScan]:
        """A sweep; body poses (K, 3), (K, 4) at `knot_stamps`."""
        request = dict(
            p_world=p_world, q_world_body=q_world_body, stamp_ns=stamp_ns, counter=counter, **faults
        )
        return self._submit("lidar", request)

    def submit_camera(
        self, p_world: Array, q_world_body: Array, *, stamp_ns: int, counter: int, **faults: float
    ) -> _Job[CameraImage]:
        """A frame; body pose (3,), (4,) at the stamp."""
        request = dict(
            p_world=p_world, q_world_body=q_world_body, stamp_ns=stamp_ns, counter=counter, **faults
        )
        return self._submit("camera", request)

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

    def _submit(self, kind: str, request: dict[str, Any]) -> _Job[Any]:
        if self._closed:
            raise RenderError("the renderer was closed")
        while not self._free:
            self._fetch(self._waiting[0])
        job: _Job[Any] = _Job(kind, self._fetch, self._free.popleft())
        self._waiting.append(job)
        try:
            self._conn.send((kind, job.slot, request))
        except OSError:
            self._fetch(job)
        return job

    def _fetch(self, job: _Job[Any]) -> None:
        """Take results, in order, until `job` has its own."""
        try:
            self.wait_ready()
            while job.value is None and not job.error:
                answer = self._receive()
                done = self._waiting.popleft()
                self._free.append(done.slot)
                if isinstance(answer, str):
                    done.error = answer
                else:
                    done.value = _read(done.kind, answer, self._slot(done.slot))
        except RenderError as error:
            self._fail_all(str(error))

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

    def _slot(self, slot: int) -> memoryview:
        return self._shared.buf[slot * self._slot_bytes : (slot + 1) * self._slot_bytes]

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def serve(setup: RenderSetup, conn: Connection, shared_name: str, slot_bytes: int) -> None:
    """The worker's life: say ready, answer requests in order, end with the parent."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent ends us
    shared = SharedMemory(shared_name)
    try:
        sensors = _built(setup, conn)
        while sensors and (request := _next(conn)):
            kind, slot, arguments = request
            try:
                header = _write(
                    sensors.render(kind, arguments), shared.buf[slot * slot_bytes : (slot + 1) * slot_bytes]
                )
                conn.send(header)
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


def _write(message: LidarScan | CameraImage, slot: memoryview) -> Header:
    """Arrays one behind the other into the slot; the rest into the header."""
    header: Header = []
    at = 0
    for name in message.__slots__:
        value = getattr(message, name)
        if isinstance(value, np.ndarray):
            target = np.frombuffer(slot, value.dtype, value.size, at)
            target[:] = value.ravel()
            at += value.nbytes
            value = (value.dtype.str, value.shape)
        header.append((name, value))
    return header


def _read(kind: str, header: Header, slot: memoryview) -> Any:
    """The message, with its own copies of the arrays."""
    fields: dict[str, Any] = {}
    at = 0
    for name, value in header:
        if isinstance(value, tuple):
            dtype, shape = value
            array = np.frombuffer(slot, dtype, int(np.prod(shape)), at).reshape(shape).copy()
            fields[name], at = array, at + array.nbytes
        else:
            fields[name] = value
    return freeze(_KINDS[kind](**fields))
