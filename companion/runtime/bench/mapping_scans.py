"""Scans for the mapping measurements: what a LiDAR saw from where, and real ones from disk.

for scan in velodyne_scans(Path("data/lidar_moosmann_hdl64"), count=4):
    scan.into(voxels)
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from companion.core.errors import InputError
from companion.core.messages import Array, Array32
from companion.mapping.voxel_map import VoxelMap
from companion.runtime.recordings import open_recording

VELODYNE, PAIR = "lidar_moosmann_hdl64", "lidar_small_gicp_pair"  # folders of real scans
_STEPS_APART = 3  # scans of the standing car; its neighbours differ in noise alone


@dataclass(frozen=True, slots=True, eq=False)
class Scan:
    """Returns (N, 3) of one sweep, m, in the body frame, whose origin is the sensor; pose in odom."""

    points_body: Array32
    R_odom_body: Array
    p_odom: Array
    surface: NDArray[np.uint32]  # (N,) triangle that each return is of; empty: not known

    def into(self, voxels: VoxelMap) -> None:
        """Insert it into a map of ours."""
        p = self.p_odom
        voxels.insert(self.points_body, R_odom_body=self.R_odom_body, p_odom=p, origin_odom=p)

    @property
    def points_odom(self) -> Array:
        """Returns (N, 3) in odom, m, as the peer takes them."""
        return np.ascontiguousarray(self.points_body.astype(np.float64) @ self.R_odom_body.T + self.p_odom)


def velodyne_scans(folder: Path, *, count: int) -> Iterator[Scan]:
    """HDL-64 sweeps of a car that stands (first 20 s of MuehlburgerTor), so one pose fits all."""
    sweeps = open_recording(folder / "MuehlburgerTor").scans()
    for sweep in islice(sweeps, 0, count * _STEPS_APART, _STEPS_APART):
        yield _at_origin(sweep.points_sensor)


def pair_scans(folder: Path) -> Iterator[Scan]:
    """The two HDL-64 scans of small_gicp's tests, each in its own frame."""
    for name in ("source", "target"):
        yield _at_origin(read_ply(folder / f"{name}.ply"))


def read_ply(path: Path) -> Array32:
    """Points (N, 3) of a binary little-endian PLY file whose vertices are floats and begin with x, y, z."""
    data = path.read_bytes()
    head, mark, body = data.partition(b"end_header\n")
    lines = head.decode("ascii", "replace").split("\n")
    columns = [line.split() for line in lines if line.startswith("property")]
    count = next((int(line.split()[2]) for line in lines if line.startswith("element vertex ")), 0)
    floats = all(kind == "float" for _, kind, *_ in columns) and [c[-1] for c in columns[:3]] == ["x", "y", "z"]
    if not mark or "format binary_little_endian 1.0" not in lines or not floats or len(body) < 4 * count * len(columns):
        raise InputError(
            "not a point cloud that can be read", file=str(path), valid="binary PLY of floats x, y, z, ..."
        )
    table = np.frombuffer(body, "<f4", count * len(columns)).reshape(count, len(columns))
    return np.ascontiguousarray(table[:, :3])


def _at_origin(points: Array32) -> Scan:
    return Scan(points, np.eye(3), np.zeros(3), np.empty(0, np.uint32))
