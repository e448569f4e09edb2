"""LiDAR and camera by ray casting: in this process, or in a worker that leaves this one free.

Both renderers give the same bytes: a result depends on the world, the configuration, the
seed, the poses and the counter of the request, not on who computes it or when. Casting holds
Python's lock, so only another process overlaps with the stack's work.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from types import TracebackType
from typing import Any, Generic, Protocol, Self, TypeVar

import numpy as np

from companion.core.messages import Array, CameraImage, LidarScan
from companion.core.node import Pending
from companion.core.rig import Rig
from sim.sensors.camera import Camera, CameraConfig
from sim.sensors.caster import Caster
from sim.sensors.lidar import Lidar, LidarConfig
from sim.world.world import World

M = TypeVar("M")


@dataclass(frozen=True)
class RenderSetup:
    """Everything that a renderer must know; `rig` is where the sensors truly sit."""

    world: World
    rig: Rig = field(default_factory=Rig)
    lidar: LidarConfig = field(default_factory=LidarConfig)
    camera: CameraConfig = field(default_factory=CameraConfig)
    seed: int = 0

    @property
    def message_bytes(self) -> int:
        """Most that the arrays of one message take."""
        pinhole = self.rig.pinhole
        return max(16 * self.lidar.rays + 64, pinhole.width_px * pinhole.height_px)


class Renderer(Protocol):
    """What the simulator's sensors ask for; see `Lidar.scan` and `Camera.frame` for the arguments."""

    def submit_lidar(
        self, p_world: Array, q_world_body: Array, *, stamp_ns: int, counter: int, **faults: float
    ) -> Pending[LidarScan]: ...

    def submit_camera(
        self, p_world: Array, q_world_body: Array, *, stamp_ns: int, counter: int, **faults: float
    ) -> Pending[CameraImage]: ...

    def close(self) -> None: ...


@dataclass(frozen=True)
class Done(Generic[M]):
    """A result that is there."""

    value: M

    def result(self) -> M:
        """The value."""
        return self.value


class Sensors:
    """The models over one scene; `render` is all that a worker needs."""

    def __init__(self, setup: RenderSetup) -> None:
        mesh, rig = setup.world.mesh, setup.rig
        caster = Caster(mesh)
        self.lidar = Lidar(setup.lidar, rig.lidar, caster, mesh, setup.seed)
        self.camera = Camera(setup.camera, rig.camera, rig.pinhole, caster=caster, mesh=mesh, seed=setup.seed)

    def render(self, kind: str, request: dict[str, Any]) -> LidarScan | CameraImage:
        """One message of kind `lidar` or `camera`."""
        return self.lidar.scan(**request) if kind == "lidar" else self.camera.frame(**request)

    def warm(self) -> None:
        """Compile and touch everything once, so that no first message stalls."""
        p, q = np.array([0.0, 0.0, 2.0]), np.array([1.0, 0.0, 0.0, 0.0])
        self.lidar.scan(np.stack([p, p]), np.stack([q, q]), stamp_ns=0, counter=0)
        self.camera.frame(p, q, stamp_ns=0, counter=0)


class InlineRenderer:
    """Renders at once, in the calling thread."""

    def __init__(self, setup: RenderSetup) -> None:
        self._sensors = Sensors(setup)
        self._sensors.warm()

    def submit_lidar(
        self, p_world: Array, q_world_body: Array, *, stamp_ns: int, counter: int, **faults: float
    ) -> Done[LidarScan]:
        """A sweep; body poses (K, 3), (K, 4) at `knot_stamps`."""
        return Done(
            self._sensors.lidar.scan(p_world, q_world_body, stamp_ns=stamp_ns, counter=counter, **faults)
        )

    def submit_camera(
        self, p_world: Array, q_world_body: Array, *, stamp_ns: int, counter: int, **faults: float
    ) -> Done[CameraImage]:
        """A frame; body pose (3,), (4,) at the stamp."""
        return Done(
            self._sensors.camera.frame(p_world, q_world_body, stamp_ns=stamp_ns, counter=counter, **faults)
        )

    def close(self) -> None:
        """Nothing to end."""

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
