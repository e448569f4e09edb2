"""One process group from the supervisor's side: started by spawning, heard through pipes."""

from __future__ import annotations

import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import IO

import msgspec

from companion.core.errors import LinkError
from companion.runtime.pipes import Assignment, Beat, Word


class Child:
    """A running group; its standard error goes to `<out>/<group>.log`, after what is there."""

    def __init__(self, assignment: Assignment) -> None:
        self.assignment = assignment
        self.started_s = time.monotonic()
        self.beat: Beat | None = None
        self.figures: dict[str, float] = {}  # the newest
        self.figures_ns = 0  # their stamp
        self.warm_cpu_s = 0.0  # spent before it ran
        self.running_s = 0.0  # since it ran, at the last beat
        self._beat_s, self._ran_s = self.started_s, 0.0
        log: IO[bytes] = (Path(assignment.out) / f"{assignment.group}.log").open("ab")
        with log:
            self._process = subprocess.Popen(
                [sys.executable, "-m", "companion.runtime.group"],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=log,
                bufsize=0,
            )
        self._send(msgspec.json.encode(assignment))
        self._reader = threading.Thread(target=self._read, name=f"read {assignment.group}", daemon=True)
        self._reader.start()

    @property
    def name(self) -> str:
        """The group's."""
        return self.assignment.group

    @property
    def pid(self) -> int:
        """Of the process."""
        return self._process.pid

    @property
    def state(self) -> str:
        """What the group last said, or `dead`."""
        if self._process.poll() is not None:
            return "dead"
        return self.beat.state if self.beat else "starting"

    @property
    def exit_code(self) -> int | None:
        """None while it runs."""
        return self._process.poll()

    @property
    def silent_s(self) -> float:
        """Since its last beat."""
        return time.monotonic() - self._beat_s

    def say(self, word: Word) -> None:
        """`go` or `stop`; a dead group does not mind."""
        self._send(msgspec.json.encode(word))

    def kill(self) -> None:
        """End it at once, even if it is stopped."""
        self._process.kill()

    def wait(self, timeout_s: float) -> bool:
        """Whether it has ended within the time; closes the pipes then."""
        try:
            self._process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            return False
        self._reader.join(1.0)
        for pipe in (self._process.stdin, self._process.stdout):
            if pipe is not None:
                pipe.close()
        return True

    def last_words(self) -> str:
        """The last line of its log."""
        lines = (Path(self.assignment.out) / f"{self.name}.log").read_text(errors="replace").strip().splitlines()
        return lines[-1] if lines else f"exit code {self.exit_code}"

    def _send(self, line: bytes) -> None:
        assert self._process.stdin is not None
        try:
            self._process.stdin.write(line + b"\n")
        except (BrokenPipeError, ValueError):
            return

    def _read(self) -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            try:
                self._take(msgspec.json.decode(line, type=Beat))
            except msgspec.DecodeError as error:
                raise LinkError(f"{self.name} said what is no beat: {line[:80]!r}") from error

    def _take(self, beat: Beat) -> None:
        self._beat_s = time.monotonic()
        if beat.state == "running":
            self._ran_s = self._ran_s or self._beat_s
            self.running_s = self._beat_s - self._ran_s
        elif beat.state != "stopping":
            self.warm_cpu_s = beat.cpu_s
        if beat.figures:
            self.figures, self.figures_ns = beat.figures, beat.stamp_ns
        self.beat = beat
