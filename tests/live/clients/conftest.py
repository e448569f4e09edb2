"""`companion sim` as a real process on free ports, for clients that know nothing of it."""

import contextlib
import json
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[3]
COMPANION = Path(sys.executable).with_name("companion")
START_S = 240.0  # kernels may have to be compiled first, on a machine that does other things
CALM = (
    "sim.render=false",
    "sim.gps.multipath_open_m=0.2",
    "sim.autopilot.parameters.COM_OF_LOSS_T=5",  # the client's timers run at the pace of a busy machine
    "sim.autopilot.parameters.RTL_RETURN_ALT=6",
)


def free_port() -> int:
    with contextlib.closing(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) as sock:
        sock.bind(("127.0.0.1", 0))
        return sock.getsockname()[1]


def until(
    condition: Callable[[], object], what: str, timeout_s: float = 60.0, said: Callable[[], object] = lambda: ""
) -> object:
    """The first true value of a condition, or a failure that names what did not come, and what was said instead."""
    end = time.monotonic() + timeout_s
    while time.monotonic() < end:
        if value := condition():
            return value
        time.sleep(0.05)
    pytest.fail(f"waited {timeout_s:g} s in vain for: {what} {said()}")


class Sim:
    """A running `companion sim`; `end` gives its summary."""

    def __init__(self, *options: str, speed: float = 1.0) -> None:
        self.mavlink, self.gcs = free_port(), free_port()
        overrides = [text for value in CALM for text in ("--set", value)]
        self._process = subprocess.Popen(
            [
                str(COMPANION), "sim", "--world", "empty", "--json", "--bus", "", f"--speed={speed}",
                f"--mavlink=udp://127.0.0.1:{self.mavlink}", f"--gcs=udp://127.0.0.1:{self.gcs}", *overrides, *options,
            ],
            cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        )  # fmt: skip
        self.said: list[str] = []
        self._reader = threading.Thread(target=self._listen, daemon=True)
        self._reader.start()

    def wait_ready(self) -> None:
        until(lambda: self._process.poll() is not None or any("ready" in s for s in self.said), "ready", START_S)
        assert self._process.poll() is None, self.said

    @property
    def pid(self) -> int:
        return self._process.pid

    def end(self, number: int = signal.SIGINT) -> dict[str, object]:
        self._process.send_signal(number)
        out = self._process.stdout.read()
        assert self._process.wait(60) == 0, self.said
        self._close()
        return json.loads(out)

    def kill(self) -> None:
        if self._process.poll() is None:
            self._process.kill()
            self._process.wait(10)
        self._close()

    def _listen(self) -> None:
        for line in self._process.stderr:
            self.said.append(line.strip())

    def _close(self) -> None:
        self._reader.join(10)
        self._process.stdout.close()
        self._process.stderr.close()


@pytest.fixture(scope="module")
def start_sim() -> Iterator[Callable[..., Sim]]:
    started: list[Sim] = []

    def start(*options: str, speed: float = 1.0) -> Sim:
        started.append(Sim(*options, speed=speed))
        started[-1].wait_ready()
        return started[-1]

    yield start
    for sim in started:
        sim.kill()


@pytest.fixture(scope="session", name="until")
def _until() -> Callable[..., object]:
    return until
