"""The libraries that the map is measured against, and how CPU time is taken."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from companion.core.errors import CompanionError, InputError
from companion.core.messages import Array
from companion.mapping.sensor_model import SensorModel
from companion.runtime.bench.mapping_scans import Scan

_REQUESTS, _REQUEST_BYTES = 300, 100_000  # small enough to be taken from what was freed
RayPer = Literal["point", "end_voxel"]
Insertion = Callable[[Scan], Callable[[], object]]
"""For a scan the work that inserts it into a map."""
OCTOMAP_MODEL = SensorModel(hit=0.7, miss=0.4, lowest=0.1192, highest=0.971)  # its own defaults


def peer(name: str) -> Any:
    """The module of a peer; CompanionError says how to get it."""
    try:
        return import_module(name)
    except ImportError as error:
        raise CompanionError(f"{name} is not installed: pip install 'understory[bench]'") from error


class OctoMap:
    """OctoMap 1.10 through pyoctomap, with its own sensor model."""

    def __init__(self, resolution_m: float, range_m: float, *, ray_per: RayPer = "point") -> None:
        self._discretize = ray_per == "end_voxel"
        self._tree = peer("pyoctomap").OcTree(resolution_m)
        self._range_m = range_m
        self._tree.setProbHit(OCTOMAP_MODEL.hit)
        self._tree.setProbMiss(OCTOMAP_MODEL.miss)
        self._tree.setClampingThresMin(OCTOMAP_MODEL.lowest)
        self._tree.setClampingThresMax(OCTOMAP_MODEL.highest)

    def insertion(self, scan: Scan) -> Callable[[], None]:
        """Work that inserts the scan: the points are brought into its form beforehand."""
        points, origin = scan.points_odom, scan.p_odom.copy()
        return lambda: self._tree.insertPointCloud(points, origin, self._range_m, False, self._discretize)

    def classes(self, centers_odom: Array) -> NDArray[np.uint8]:
        """0 unknown, 1 free, 2 occupied (N,) at voxel centres (N, 3), m."""
        labels = np.asarray(self._tree.getLabels(np.ascontiguousarray(centers_odom)))  # it counts from -1
        return (labels.ravel() + 1).astype(np.uint8)


class Prototype:
    """A map of somebody else from a Python file, which has a class VoxMap.

    VoxMap(resolution_m, range_m).insert(points_body (N, 3) float32, R_odom_body (3, 3), p_odom (3,)) takes a scan.
    """

    def __init__(self, file: Path) -> None:
        """Import the file; InputError if there is none, or no such class in it."""
        if file.suffix != ".py" or not file.is_file():
            raise InputError("no such Python file", field="--prototype", file=str(file), valid="a .py file")
        sys.path.insert(0, str(file.parent.resolve()))  # by its own name: Numba's cache knows it by that alone
        module = import_module(file.stem)
        if not hasattr(module, "VoxMap"):
            raise InputError("no class VoxMap in it", field="--prototype", file=str(file), valid="a file that has one")
        self._make = module.VoxMap

    def empty(self, resolution_m: float, range_m: float) -> Insertion:
        """Insertions into a new map."""
        voxels = self._make(resolution_m, range_m)
        return lambda scan: lambda: voxels.insert(scan.points_body, scan.R_odom_body, scan.p_odom)


def cpu_ms(work: Callable[[], object]) -> float:
    """CPU time of one call in this process, ms; the allocator is tidy when it begins.

    OctoMap frees a million small pieces per scan, which glibc sorts when others ask for memory, 10,000 at each
    request: up to 15 ms of OctoMap's that the next in turn would be charged with.
    """
    for _ in range(_REQUESTS):
        np.empty(_REQUEST_BYTES, np.uint8)
    started = time.process_time_ns()
    work()
    return (time.process_time_ns() - started) * 1e-6


def alternate(works: dict[str, Callable[[], object]], *, rounds: int) -> dict[str, float]:
    """Smallest CPU ms of each work; they take turns, so that the machine's mood meets all alike."""
    best = dict.fromkeys(works, np.inf)
    for _ in range(rounds):
        for name, work in works.items():
            best[name] = min(best[name], cpu_ms(work))
    return best


def copy_gb_s() -> float:
    """Bytes per second that this machine copies in memory, GB/s (each byte counted once)."""
    source = np.ones(64 << 20, np.uint8)
    target = np.empty_like(source)
    ms = alternate({"copy": lambda: np.copyto(target, source)}, rounds=6)["copy"]
    return float(source.nbytes / ms * 1e-6)
