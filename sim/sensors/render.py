"""LiDAR and camera by ray casting: in this process, or in a worker that leaves this one free.

Both renderers give the same bytes: a result depends on the world, the configuration, the
seed, the poses and the counter of the request, not on who computes it or when. Casting holds
Python's lock, so only another process overlaps with the stack's work.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from types import TracebackType
from typing import Any, Generic, Protocol, Self, TypeVar, cast

import numpy as np

from companion.core.messages import Array, CameraImage, LidarScan
from companion.core.node import Pending
from companion.core.rig import Rig
from sim.sensors.camera import CameraConfig
from sim.sensors.lidar import LidarConfig
from sim.sensors.scene import RenderSetup, Sensors
from sim.sensors.worker import RenderError, Worker
from sim.world.model import World

__all__ = ["InlineRenderer", "NoRenderer", "RenderError", "Renderer", "WorkerRenderer"]
M = TypeVar("M")


class Renderer(Protocol):
    """What the simulator's sensors ask for."""

    cpu_s: dict[str, float]  # CPU seconds spent on "lidar" and "camera" so far, wherever

    @property
    def busy(self) -> bool:
        """Whether a sweep or frame should rather be left out now, as a driver on a slow computer does."""

    def submit_lidar(
        self, p_world: Array, q_world_body: Array, *, stamp_ns: int, counter: int, **options: float
    ) -> Pending[LidarScan]:
        """A sweep that ends at the stamp, from body poses (K, 3), (K, 4) at `knot_stamps`.

        Faults as in `Lidar.scan`: `lost_fraction`, `dust_fraction`; pieces, too: `part`, `parts`.
        """

    def submit_camera(
        self, p_world: Array, q_world_body: Array, *, stamp_ns: int, counter: int, **options: float
    ) -> Pending[CameraImage]:
        """A frame at the stamp, from the body pose (3,), (4,); the fault is `gain`, as in `Camera.frame`."""

    def close(self) -> None:
        """Free what the renderer holds."""


@dataclass(frozen=True)
class Done(Generic[M]):
    """A result that is there."""

    value: M

    def result(self) -> M:
        """The value."""
        return self.value

    def ready(self) -> bool:
        """Always."""
        return True


@dataclass(frozen=True)
class JoinedSweep:
    """A sweep whose pieces were submitted while it went on, so that a worker keeps pace with it."""

    pieces: tuple[Pending[LidarScan], ...]

    def result(self) -> LidarScan:
        """All pieces as one message, in the order of time."""
        scans = [piece.result() for piece in self.pieces]
        return LidarScan(
            stamp_ns=scans[-1].stamp_ns,
            points_sensor=np.concatenate([s.points_sensor for s in scans]),
            point_age_s=np.concatenate([s.point_age_s for s in scans]),
            miss_dirs_sensor=np.concatenate([s.miss_dirs_sensor for s in scans]),
            miss_age_s=np.concatenate([s.miss_age_s for s in scans]),
        )

    def ready(self) -> bool:
        """Whether the last piece is there: they are served in order."""
        return self.pieces[-1].ready()


class _Base(ABC):
    """The requests, written once; a subclass says how one is served."""

    def submit_lidar(
        self, p_world: Array, q_world_body: Array, *, stamp_ns: int, counter: int, **options: float
    ) -> Pending[LidarScan]:
        """See Renderer."""
        request = dict(p_world=p_world, q_world_body=q_world_body, stamp_ns=stamp_ns, counter=counter)
        return cast("Pending[LidarScan]", self._submit("lidar", {**request, **options}))

    def submit_camera(
        self, p_world: Array, q_world_body: Array, *, stamp_ns: int, counter: int, **options: float
    ) -> Pending[CameraImage]:
        """See Renderer."""
        request = dict(p_world=p_world, q_world_body=q_world_body, stamp_ns=stamp_ns, counter=counter)
        return cast("Pending[CameraImage]", self._submit("camera", {**request, **options}))

    @abstractmethod
    def _submit(self, kind: str, request: dict[str, Any]) -> Pending[Any]: ...

    @abstractmethod
    def close(self) -> None:
        """Free what the renderer holds."""

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


class InlineRenderer(_Base):
    """Renders at once, in the calling thread."""

    def __init__(self, world: World, lidar: LidarConfig, camera: CameraConfig, rig: Rig, *, seed: int) -> None:
        self.cpu_s = {"lidar": 0.0, "camera": 0.0}
        self._sensors = Sensors(RenderSetup(world.mesh, lidar, camera, rig, seed, world.walkers, world.air))
        self._sensors.warm()

    @property
    def busy(self) -> bool:
        """Never: a request is served before the next can come."""
        return False

    def _submit(self, kind: str, request: dict[str, Any]) -> Pending[Any]:
        message, cpu_s = self._sensors.render(kind, request)
        self.cpu_s[kind] += cpu_s
        return Done(message)

    def close(self) -> None:
        """Nothing to end."""


class WorkerRenderer(_Base):
    """Renders in a spawned process: `submit_*` returns at once, `result` waits; served in order.

    A script that uses it must guard its entry with `if __name__ == "__main__"`, as every
    spawned process demands. The worker compiles while its parent goes on; `wait_ready`
    waits for it. It ends by itself when its parent is gone. `result` raises RenderError with
    the worker's own traceback. It is `busy` while `most_waiting` requests are unserved; without
    that number it never is, and nothing is left out.
    """

    def __init__(
        self,
        world: World,
        lidar: LidarConfig,
        camera: CameraConfig,
        rig: Rig,
        *,
        seed: int,
        most_waiting: int | None = None,
    ) -> None:
        self.cpu_s = {"lidar": 0.0, "camera": 0.0}
        self._most_waiting = most_waiting
        self._worker = Worker(RenderSetup(world.mesh, lidar, camera, rig, seed, world.walkers, world.air), self.cpu_s)

    def wait_ready(self) -> None:
        """Block until the worker has built and compiled everything; raises RenderError."""
        self._worker.wait_ready()

    @property
    def busy(self) -> bool:
        """Whether the worker is behind by `most_waiting` requests."""
        return self._most_waiting is not None and self._worker.waiting() >= self._most_waiting

    def _submit(self, kind: str, request: dict[str, Any]) -> Pending[Any]:
        return self._worker.submit(kind, request)

    def close(self) -> None:
        """End the worker and free its memory; results not fetched fail with RenderError."""
        self._worker.close()


class NoRenderer(_Base):
    """A vehicle without LiDAR and camera: always busy, so nothing is ever asked of it."""

    busy = True

    def __init__(self) -> None:
        self.cpu_s: dict[str, float] = {}

    def _submit(self, kind: str, request: dict[str, Any]) -> Pending[Any]:
        raise RenderError(f"this vehicle has no {kind}")

    def close(self) -> None:
        """Nothing to end."""
