"""Ray casting against triangles: Embree through Open3D, on one thread."""

from __future__ import annotations

import ctypes
from typing import Any

import libusb_package
import numpy as np
from numpy.typing import NDArray

from companion.core.messages import Array32
from sim.world.mesh import Mesh

NO_HIT = 0xFFFFFFFF  # Open3D's INVALID_ID


class Caster:
    """First hits of rays in a mesh; the same rays give the same bits."""

    def __init__(self, mesh: Mesh) -> None:
        self._o3d = _open3d()
        self._scene = self._o3d.t.geometry.RaycastingScene(nthreads=1)
        tensor = self._o3d.core.Tensor
        self._scene.add_triangles(tensor(mesh.vertices.copy()), tensor(mesh.triangles.copy()))

    def cast(self, rays: Array32) -> tuple[Array32, NDArray[np.uint32]]:
        """Rays (N, 6), origin and direction -> distance in lengths of the direction (inf: none), triangle."""
        if not len(rays):
            return np.empty(0, np.float32), np.empty(0, np.uint32)
        hits = self._scene.cast_rays(self._o3d.core.Tensor.from_numpy(rays), nthreads=1)
        return hits["t_hit"].numpy(), hits["primitive_ids"].numpy()


def _open3d() -> Any:
    """Import Open3D; its wheel needs libusb, which libusb-package brings along."""
    ctypes.CDLL(str(libusb_package.get_library_path()), ctypes.RTLD_GLOBAL)
    import open3d

    return open3d
