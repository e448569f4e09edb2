"""Real flights and drives with an IMU, and fixes or optical flow to go with it, read into plain arrays.

All come out as body FLU and world ENU, seconds from the first IMU sample.
"""

from __future__ import annotations

import csv
import zipfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from companion.core.errors import InputError
from companion.core.messages import Array

_EARTH_M = 6_378_137.0
_TO_FLU = np.array([1.0, -1.0, -1.0])


@dataclass(frozen=True, slots=True)
class InertialRecording:
    """IMU at its own rate, and where the vehicle was by a satellite receiver."""

    name: str
    imu_s: Array  # (N,)
    imu: Array  # rad/s and m/s2, (N, 6)
    fix_s: Array  # (M,)
    fix_p: Array  # m, (M, 3)

    def pieces(self, start_s: float, end_s: float) -> Array:
        """IMU pieces (K, 7) that fill (start, end]: a sample holds until the stamp it bears."""
        first = int(np.searchsorted(self.imu_s, start_s, side="right"))
        last = int(np.searchsorted(self.imu_s, end_s))
        rows = np.minimum(np.arange(first, last + 1), len(self.imu_s) - 1)
        ends = np.append(self.imu_s[first:last], end_s)
        dt = np.diff(ends, prepend=start_s)
        kept = dt > 0.0
        return np.column_stack([dt, self.imu[rows]])[kept]

    def shifted(self, offset_s: float) -> InertialRecording:
        """The same with the fixes' clock put forward."""
        return InertialRecording(self.name, self.imu_s, self.imu, self.fix_s + offset_s, self.fix_p)


@dataclass(frozen=True, slots=True)
class FlowRecording:
    """A downward flow camera and range finder beside the IMU; fixes are for comparison alone."""

    inertial: InertialRecording
    speed_m_s: Array  # of the fixes' receiver, over ground, (M,)
    flow_s: Array  # (K,)
    flow: Array  # v_body x and y over range, 1/s, (K, 2), rotation taken out
    range_m: Array  # along body -z, (K,)


def rtk_flights(folder: Path) -> list[Path]:
    """The quadrotor flights with RTK (ANSFL); raises InputError if there are none."""
    files = sorted(folder.glob("*_path_*.npz"))
    if not files:
        raise InputError("no flights", file=str(folder), valid="imu_rtk_quadrotor_ansfl with *_path_*.npz")
    return files


def rtk_flight(path: Path) -> InertialRecording:
    """One of them: the first of its IMUs, fixes at 10 Hz (D. Hurwitz and I. Klein, 2023)."""
    with np.load(path) as data:
        imu, truth = data["imu1"].astype(np.float64), data["gt"]
    east_north_up = np.column_stack([truth[:, 8], truth[:, 7], -truth[:, 9]])
    rows = np.column_stack([np.radians(imu[:, 7:10]), imu[:, 4:7]])
    zero = imu[0, 0]
    return InertialRecording(path.stem, imu[:, 0] - zero, rows, truth[:, 0] - zero, east_north_up)


def flow_flight(path: Path) -> FlowRecording:
    """`quadOptFlowLogData.zip` of InertialNav: body FRD, milliseconds, flow 9.5 Hz, range 0.13 m on the ground."""
    if not path.is_file():
        raise InputError("no such file", file=str(path), valid="quadOptFlowLogData.zip")
    with zipfile.ZipFile(path) as archive:
        imu, flow, ranges, gps = (_table(archive, name) for name in ("IMU", "FLOW", "DIST", "GPS"))
    rows = np.column_stack([imu[:, 2:5] * _TO_FLU, imu[:, 5:8] * _TO_FLU])
    latitude = np.radians(gps[:, 6] - gps[0, 6])
    longitude = np.radians(gps[:, 7] - gps[0, 7]) * np.cos(np.radians(gps[0, 6]))
    fixes = np.column_stack([_EARTH_M * longitude, _EARTH_M * latitude, gps[:, 8]])
    stamps = flow[:, 0] * 1e-3
    newest = np.clip(np.searchsorted(ranges[:, 0] * 1e-3, stamps, side="right") - 1, 0, None)
    # The flow is about the camera's axes: motion ahead turns it about -y, motion to the left about -x.
    derotated = flow[:, 1:3] + flow[:, 6:8]
    return FlowRecording(
        InertialRecording("quadOptFlow", imu[:, 0] * 1e-3, rows, gps[:, 0] * 1e-3, fixes),
        gps[:, 10],
        stamps,
        -derotated[:, ::-1],
        ranges[newest, 1],
    )


def kitti_drive(folder: Path) -> InertialRecording:
    """gtsam's KITTI drive: IMU at 100 Hz, GPS at 1 Hz, 471 s (A. Geiger et al., IJRR 2013)."""
    imu_file, gps_file = folder / "KittiEquivBiasedImu.txt", folder / "KittiGps_converted.txt"
    if not imu_file.is_file() or not gps_file.is_file():
        raise InputError("no KITTI drive", file=str(folder), valid=f"{imu_file.name} and {gps_file.name}")
    imu = np.loadtxt(imu_file, skiprows=1)
    with gps_file.open(encoding="utf-8") as lines:
        gps = np.array([[float(v) for v in row] for row in list(csv.reader(lines))[1:]])
    rows = np.column_stack([imu[:, 5:8], imu[:, 2:5]])
    return InertialRecording("KITTI", imu[:, 0] - imu[0, 0], rows, gps[:, 0] - imu[0, 0], gps[:, 1:4])


def _table(archive: zipfile.ZipFile, name: str) -> Array:
    with archive.open(f"{name}.txt") as lines:
        return np.loadtxt(lines)
