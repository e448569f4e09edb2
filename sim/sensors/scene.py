"""The ray-cast sensors over one world: everything that a renderer needs, wherever it runs."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any

import numpy as np

from companion.core.messages import CameraImage, LidarScan
from companion.core.rig import Rig
from sim.sensors.camera import Camera, CameraConfig
from sim.sensors.caster import Caster
from sim.sensors.lidar import Lidar, LidarConfig
from sim.world.mesh import Mesh
from sim.world.model import CLEAR, Air
from sim.world.walkers import NOBODY, Walkers


@dataclass(frozen=True)
class RenderSetup:
    """Everything that a renderer must know; `rig` is where the sensors truly sit."""

    mesh: Mesh
    lidar: LidarConfig
    camera: CameraConfig
    rig: Rig
    seed: int
    walkers: Walkers = NOBODY
    air: Air = CLEAR

    @property
    def message_bytes(self) -> int:
        """Most that the arrays of one message take."""
        pinhole = self.rig.pinhole
        return max(16 * self.lidar.rays, pinhole.width_px * pinhole.height_px)


class Sensors:
    """The models over one mesh."""

    def __init__(self, setup: RenderSetup) -> None:
        mesh, rig, walkers = setup.mesh, setup.rig, setup.walkers
        self._air = setup.air
        caster = Caster(mesh)
        self.lidar = Lidar(setup.lidar, rig.lidar, caster, mesh, setup.seed, walkers=walkers)
        self.camera = Camera(
            setup.camera, rig.camera, rig.pinhole, caster=caster, mesh=mesh, seed=setup.seed, walkers=walkers
        )

    def render(self, kind: str, request: dict[str, Any]) -> tuple[LidarScan | CameraImage, float]:
        """One message of kind `lidar` or `camera`, and the CPU seconds that it took."""
        start_s = time.thread_time()
        request = self._in_air(kind, request)
        message = self.lidar.scan(**request) if kind == "lidar" else self.camera.frame(**request)
        return message, time.thread_time() - start_s

    def _in_air(self, kind: str, request: dict[str, Any]) -> dict[str, Any]:
        """The request with what light and air take, besides the faults that it asks for."""
        air = self._air
        if kind == "camera":
            return {**request, "gain": air.light * request.get("gain", 1.0)}
        lost = 1.0 - (1.0 - air.lidar_loss) * (1.0 - request.get("lost_fraction", 0.0))
        dust = 1.0 - (1.0 - air.dust) * (1.0 - request.get("dust_fraction", 0.0))
        return {**request, "lost_fraction": lost, "dust_fraction": dust}

    def warm(self) -> None:
        """Compile and touch everything once, so that no first message stalls."""
        p, q = np.array([0.0, 0.0, 2.0]), np.array([1.0, 0.0, 0.0, 0.0])
        self.lidar.scan(np.stack([p, p]), np.stack([q, q]), stamp_ns=0, counter=0)
        self.camera.frame(p, q, stamp_ns=0, counter=0)
