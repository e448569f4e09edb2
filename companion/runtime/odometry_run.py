"""Run LiDAR odometry over a recording, and say how far it is from the reference beside it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from time import thread_time

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from companion.core.messages import Array, RegisteredScan
from companion.estimation.lidar_only import LidarOdometry, LidarOnlyConfig
from companion.runtime.recordings import Recording, open_recording
from companion.runtime.trajectory_error import TrackError, path_length, track_error


@dataclass(frozen=True, slots=True)
class OdometryReport:
    """One pose per scan, and the figures."""

    name: str
    stamps_ns: Array  # int64, (N,)
    p_odom: Array  # m, (N, 3)
    q_odom_body: Array  # wxyz, (N, 4)
    path_length_m: float
    reference_length_m: float | None  # found by another method, over the whole recording
    reference_source: str  # "" if there is no reference track
    error: TrackError | None
    cpu_ms_per_scan: float  # median, first scan left out
    inlier_fraction: float  # mean
    files: tuple[Path, ...]  # written


def run_odometry(
    source: Path,
    *,
    out: Path | None = None,
    on_registered: Callable[[RegisteredScan], None] | None = None,
    config: LidarOnlyConfig | None = None,
) -> OdometryReport:
    """LiDAR-only odometry over the recording in the folder `source`.

    Writes trajectory.csv (TUM: s x y z qx qy qz qw) and trajectory.png into `out`; hands each
    registered scan to `on_registered`, for example to a map. Raises InputError if `source`
    is no recording that can be read.
    """
    recording = open_recording(source)
    odometry = LidarOdometry(config or LidarOnlyConfig())
    stamps, positions, attitudes, cpu_s, inliers = [], [], [], [], []
    for scan in recording.scans():
        started = thread_time()
        registered = odometry.register(scan)
        cpu_s.append(thread_time() - started)
        stamps.append(registered.stamp_ns)
        positions.append(registered.p_odom)
        attitudes.append(registered.q_odom_body)
        inliers.append(odometry.inlier_fraction)
        if on_registered:
            on_registered(registered)
    t, p, q = np.array(stamps), np.array(positions), np.array(attitudes)
    error = _compare(recording, t, p)
    return OdometryReport(
        name=recording.name,
        stamps_ns=t,
        p_odom=p,
        q_odom_body=q,
        path_length_m=path_length(p),
        reference_length_m=recording.reference_length_m,
        reference_source=recording.reference.source if recording.reference else "",
        error=error,
        cpu_ms_per_scan=float(np.median(cpu_s[1:] or cpu_s)) * 1e3,
        inlier_fraction=float(np.mean(inliers[1:] or inliers)),
        files=_write(out, recording, (t, p, q), error) if out else (),
    )


def _compare(recording: Recording, t: Array, p: Array) -> TrackError | None:
    reference = recording.reference
    if reference is None:
        return None
    return track_error(t, p, reference.stamps_ns, reference.p, flat=reference.flat)


def _write(
    out: Path, recording: Recording, track: tuple[Array, Array, Array], error: TrackError | None
) -> tuple[Path, ...]:
    out.mkdir(parents=True, exist_ok=True)
    table, picture = out / "trajectory.csv", out / "trajectory.png"
    t, p, q = track
    lines = ["# timestamp_s x y z qx qy qz qw"]
    for stamp, at, (w, x, y, z) in zip(t.tolist(), p, q, strict=True):
        values = " ".join(f"{v:.6f}" for v in (*at, x, y, z, w))
        lines.append(f"{stamp // 10**9}.{stamp % 10**9:09d} {values}")
    table.write_text("\n".join(lines) + "\n")
    _draw(recording, p, error).savefig(picture, dpi=150, metadata={"Software": None})
    return table, picture


def _draw(recording: Recording, p: Array, error: TrackError | None) -> Figure:
    figure = Figure(figsize=(7, 5), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    track = p if error is None else error.aligned
    if recording.reference is not None:
        axes.plot(*recording.reference.p[:, :2].T, color="#000000", lw=2, label=recording.reference.source)
    axes.plot(*track[:, :2].T, color="#0072B2", lw=1.2, label="LiDAR odometry")
    axes.plot(*track[0, :2], "o", color="#009E73", ms=5, label="start")
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_xlabel("x, m")
    axes.set_ylabel("y, m")
    axes.set_title(f"{recording.name}: {path_length(p):.1f} m in {len(p)} scans", loc="left")
    axes.legend(frameon=False)
    return figure
