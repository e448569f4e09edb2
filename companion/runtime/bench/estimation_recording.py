"""A flight as its sensors saw it, recorded once and replayed into one estimator after another.

record_course(course, folder, config, sim=sim, mission=mission)
for time_ns, topic, message in heard(folder): ...

The vehicle is flown by the truth, so that every estimator sees the same flight. A recording is a folder with
the log's file (`flight.log`: IMU, LiDAR, camera, truth) and the true biases of the IMU (`biases.npz`).
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from companion.autopilot.node import AutopilotNode
from companion.config import Config
from companion.core import topics
from companion.core.errors import CompanionError, InputError
from companion.core.messages import Array, GroundTruth
from companion.core.node import Node, Topic
from companion.mission.model import Mission
from companion.runtime.bench.tracking_pilot import Course, PilotNode, TrueOdometryNode
from companion.runtime.codec import decode, summed
from companion.runtime.lockstep import Lockstep
from companion.runtime.log_file import MESSAGE, LogFile, read_log
from companion.stack import build
from companion.tracking.node import TrackingNode

KEPT: dict[str, Topic[Any]] = {t.name: t for t in (topics.IMU, topics.LIDAR, topics.CAMERA, topics.TRUTH)}
LOG, BIASES = "flight.log", "biases.npz"
_STEP_NS = 100_000_000
_PATIENCE_S = 60.0


class Aircraft(Protocol):
    """The simulator's node, as far as a recording must know it."""

    @property
    def imu_bias_body(self) -> Array:
        """Present true biases, (6,): gyro rad/s, accelerometer m/s2."""
        ...


class _Tape:
    """A tap that writes what the sensors say."""

    def __init__(self, path: Path, aircraft: Aircraft) -> None:
        self._file, self._aircraft = LogFile(path), aircraft
        self.stamps_ns: list[int] = []
        self.biases: list[Array] = []
        self.truth: GroundTruth | None = None

    def published(self, now_ns: int, source: str, topic: Topic[Any], message: Any) -> int:
        """Write it if an estimator or the score wants it."""
        if topic.name in KEPT:
            data, digest, _ = summed(message, stored=True)
            self._file.message(now_ns, source, topic.name, data, digest)
        if topic is topics.LIDAR:
            self.stamps_ns.append(message.stamp_ns)
            self.biases.append(self._aircraft.imu_bias_body)
        if topic is topics.TRUTH:
            self.truth = message
        return 0

    def fed(self, now_ns: int, node: str, event: str, number: int) -> None:
        """Deliveries do not matter."""

    def close(self, biases: Path) -> None:
        """Finish both files."""
        self._file.close()
        np.savez(biases, stamps_ns=np.array(self.stamps_ns), biases=np.array(self.biases))


def record_course(course: Course, folder: Path, config: Config, *, sim: Node, mission: Mission) -> None:
    """Fly the course by the truth and write what the sensors said; raises CompanionError if it cannot be flown.

    `sim` is a fresh simulator's node that is an `Aircraft`, too.
    """
    folder.mkdir(parents=True, exist_ok=True)
    kinds = (TrackingNode, AutopilotNode)
    pilot = PilotNode(course, turns=True)
    nodes = [sim, TrueOdometryNode(), *build(config, mission, seed=0, only=kinds), pilot]
    tape = _Tape(folder / f"{LOG}.part", sim)  # type: ignore[arg-type]
    delays = {n: {k: round(v * 1e6) for k, v in d.items()} for n, d in config.lockstep.delay_ms.items()}
    lockstep = Lockstep(nodes, delays_ns=delays, tap=tape)
    try:
        while not pilot.done:
            lockstep.run_until(lockstep.now_ns + _STEP_NS)
            _check(tape.truth, pilot, lockstep.now_ns)
        lockstep.settle()
    finally:
        tape.close(folder / BIASES)
    (folder / f"{LOG}.part").rename(folder / LOG)


def heard(folder: Path) -> Iterator[tuple[int, Topic[Any], Any]]:
    """Arrival time in ns, topic and message, in the order of arrival; also of a flight flown with --record."""
    path = folder / LOG
    if not path.is_file():
        raise InputError("no recording", file=str(path), valid="what `bench estimation` or `fly --record` wrote")
    for entry in read_log(path):
        if entry[0] == MESSAGE and entry[3] in KEPT and entry[4] is not None:
            topic = KEPT[entry[3]]
            yield entry[1], topic, decode(entry[4], topic.type)


def true_biases(folder: Path) -> tuple[Array, Array] | None:
    """Stamps in ns (N,) and biases (N, 6), gyro then accelerometer; None where nobody wrote them."""
    path = folder / BIASES
    if not path.is_file():
        return None
    with np.load(path) as file:
        return file["stamps_ns"], file["biases"]


def _check(truth: GroundTruth | None, pilot: PilotNode, now_ns: int) -> None:
    if truth is not None and truth.contact:
        raise CompanionError(f"the recorded flight touched {truth.contact}: try another --seed")
    if pilot.begun_ns is None and now_ns > _PATIENCE_S * 1e9:
        raise CompanionError(f"the vehicle did not take off within {_PATIENCE_S:g} s")
