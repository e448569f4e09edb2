"""Real recordings that nobody here made, read into the stack's own messages.

recording = open_recording(Path(".../lidar_moosmann_hdl64/DurlacherTor"))
for scan in recording.scans(): ...            # LidarScan, in stamp order
recording.reference                           # where the vehicle was, if it is known
"""

from __future__ import annotations

import csv
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from companion.core.errors import InputError
from companion.core.messages import Array, Array32, ImuSample, LidarScan

_METRES_PER_UNIT = 0.002  # of the range images
_KINDS = "a folder with img.cfg and scan*.png, with velodyne_dist/, or with scans.npz"


@dataclass(frozen=True, slots=True)
class Reference:
    """A track to compare with, in a frame of its own."""

    source: str
    stamps_ns: Array  # int64, (N,)
    p: Array  # m, (N, 3)
    flat: bool  # only x and y are to be trusted


@dataclass(frozen=True, slots=True)
class Recording:
    """One recorded drive; iterate `scans()` as often as you like."""

    name: str
    scan_count: int
    scans: Callable[[], Iterator[LidarScan]]
    imu: tuple[ImuSample, ...] = ()  # none of today's recordings has usable inertial data
    reference: Reference | None = None
    reference_length_m: float | None = None  # path length that an independent method found


def open_recording(path: Path) -> Recording:
    """Recognise the format by its files; raises InputError if there is none that is known."""
    if not path.is_dir():
        raise InputError("no such folder", file=str(path), valid=_KINDS)
    if (path / "img.cfg").is_file():
        return _durlacher(path)
    if (path / "velodyne_dist").is_dir():
        return _muehlburger(path)
    if (path / "scans.npz").is_file():
        return _norlab(path)
    inside = sorted(p.name for p in path.iterdir() if p.is_dir())
    hint = f"{_KINDS}; did you mean one of its folders {', '.join(inside)}?" if inside else _KINDS
    raise InputError("not a recording that can be read", file=str(path), valid=hint)


# --- HDL-64 range images of F. Moosmann ---------------------------------------------------


@dataclass(frozen=True, slots=True)
class _Sweep:
    image: Path
    end_ns: int
    duration_s: float


def _durlacher(path: Path) -> Recording:
    rows = [r.split(";") for r in (path / "imu.cfg").read_text().splitlines() if r[:2] == "20"]
    stamps = np.array([_stamp_ns(r[0]) for r in rows])
    positions = np.array([[float(x) for x in r[14:17]] for r in rows])
    images = sorted(path.glob("scan*.png"))
    if len(images) != len(rows):
        raise InputError(f"{len(rows)} rows for {len(images)} images", file=str(path / "imu.cfg"))
    period_s = float(np.median(np.diff(stamps))) * 1e-9
    # The files do not say which instant of a sweep its row is for. Taken as the start, odometry
    # and INS agree to 0.09 m over 16 m; taken as the end, to 0.32 m.
    ends = stamps + round(period_s * 1e9)
    sweeps = [_Sweep(i, int(e), period_s) for i, e in zip(images, ends, strict=True)]
    mask = np.asarray(_read_image(path / "mask.png") > 0)
    dirs = _directions(path / "img.cfg", multiplier=False)
    reference = Reference("GNSS/INS", stamps, positions - positions[0], flat=True)
    return Recording(path.name, len(images), lambda: _read_sweeps(sweeps, dirs, mask), reference=reference)


def _muehlburger(path: Path) -> Recording:
    folder = path / "velodyne_dist"
    starts, ends = (
        [_stamp_ns(line) for line in (folder / f"timestamps_{end}.txt").read_text().split("\n") if line]
        for end in ("start", "end")
    )
    images = sorted((folder / "data").glob("*.png"))
    sweeps = [_Sweep(i, e, (e - s) * 1e-9) for i, s, e in zip(images, starts, ends, strict=True)]
    dirs = _directions(folder / "velodyne_config.txt", multiplier=True)
    mask = np.ones((dirs.shape[0], dirs.shape[1]), np.bool_)
    # 291.5 m: VGICP over the same scans, see SOURCE.txt beside the data.
    scans = lambda: _read_sweeps(sweeps, dirs, mask)  # noqa: E731
    return Recording(path.name, len(images), scans, reference_length_m=291.5)


def _directions(config: Path, *, multiplier: bool) -> Array:
    """Unit direction of every pixel, (rows, columns, 3): x forward, y left, z up."""
    line = next(r for r in config.read_text().splitlines() if r and not r.startswith("#"))
    numbers = [float(x) for x in line.replace(";", " ").split()][1 if multiplier else 0 :]
    columns, rows = int(numbers[0]), int(numbers[1])
    first, last = np.radians(numbers[2]), np.radians(numbers[3])
    azimuth = first + (last - first) * (np.arange(columns) + 0.5) / columns
    elevation = -np.radians(numbers[4 : 4 + rows])  # the file counts downward
    if len(elevation) != rows:
        raise InputError(f"{len(elevation)} vertical angles for {rows} rows", file=str(config))
    flat = np.cos(elevation)[:, None]
    up = np.broadcast_to(np.sin(elevation)[:, None], (rows, columns))
    return np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), up], axis=-1)


def _read_sweeps(sweeps: list[_Sweep], dirs: Array, mask: NDArray[np.bool_]) -> Iterator[LidarScan]:
    """The sensor turns through the columns from left to right, once per sweep.

    Pixels without return are not reported as misses: why there was none is not recorded.
    """
    columns = dirs.shape[1]
    share = np.broadcast_to(1.0 - (np.arange(columns) + 0.5) / columns, dirs.shape[:2])
    for sweep in sweeps:
        units = _read_image(sweep.image)
        if units.shape != dirs.shape[:2]:
            raise InputError(f"{units.shape} pixels instead of {dirs.shape[:2]}", file=str(sweep.image))
        seen = (units > 0) & mask
        points = dirs[seen] * (units[seen] * _METRES_PER_UNIT)[:, None]
        yield _scan(sweep.end_ns, points, share[seen] * sweep.duration_s)


def _read_image(path: Path) -> Array:
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if image is None:
        raise InputError("not a readable image", file=str(path))
    return image.astype(np.float64)


# --- norlab_icp_mapper's example ----------------------------------------------------------


def _norlab(path: Path) -> Recording:
    archive = np.load(path / "scans.npz")
    names = sorted((k[:-4] for k in archive.files if k.endswith("_xyz")), key=_norlab_stamp_ns)

    def scans() -> Iterator[LidarScan]:
        for name in names:
            after_start_s = archive[f"{name}_t"] * 1e-9
            sweep_s = 0.1  # 10 Hz; the stamp is the start of the sweep
            end_ns = _norlab_stamp_ns(name) + round(sweep_s * 1e9)
            yield _scan(end_ns, archive[f"{name}_xyz"], np.maximum(sweep_s - after_start_s, 0.0))

    with (path / "trajectory.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    stamps = [int(r["header.stamp.sec"]) * 10**9 + int(r["header.stamp.nanosec"]) for r in rows]
    p = np.array([[float(r[f"pose.pose.position.{axis}"]) for axis in "xyz"] for r in rows])
    reference = Reference("ICP of norlab_icp_mapper", np.array(stamps), p - p[0], flat=False)
    return Recording(path.name, len(names), scans, reference=reference)


def _norlab_stamp_ns(name: str) -> int:
    seconds, nanoseconds = name.split("_")
    return int(seconds) * 10**9 + int(nanoseconds)


# --- common -------------------------------------------------------------------------------


def _scan(stamp_ns: int, points: Array, age_s: Array) -> LidarScan:
    return LidarScan(
        stamp_ns=stamp_ns,
        points_sensor=_as32(points),
        point_age_s=_as32(age_s),
        miss_dirs_sensor=np.empty((0, 3), np.float32),
        miss_age_s=np.empty(0, np.float32),
    )


def _as32(values: Array) -> Array32:
    return np.ascontiguousarray(values, np.float32)


def _stamp_ns(text: str) -> int:
    """`2010-03-11 13:49:14.906733354`, taken as UTC, to ns: datetime itself stops at microseconds."""
    whole, fraction = text.strip().split(".")
    at = datetime.strptime(whole, "%Y-%m-%d %H:%M:%S").replace(tzinfo=UTC)
    return int(at.timestamp()) * 10**9 + int(fraction.ljust(9, "0"))
