"""`companion odometry`: LiDAR odometry over a real recording."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.table import Table

from companion.runtime.odometry_run import OdometryReport, run_odometry


def odometry(
    source: Annotated[Path, typer.Argument(help="Folder of a recording.")],
    out: Annotated[Path | None, typer.Option(help="Write trajectory.csv and trajectory.png there.")] = None,
) -> None:
    """Follow the LiDAR of a recording. Example: companion odometry data/lidar_moosmann_hdl64/DurlacherTor."""
    report = run_odometry(source, out=out)
    console = Console()
    console.print(_table(report))
    for file in report.files:
        console.print(f"wrote {file}", highlight=False, soft_wrap=True)


def _table(report: OdometryReport) -> Table:
    table = Table(title=f"LiDAR odometry: {report.name}", title_justify="left", show_header=False)
    seconds = (report.stamps_ns[-1] - report.stamps_ns[0]) * 1e-9
    table.add_row("scans", f"{len(report.stamps_ns)} in {seconds:.1f} s")
    table.add_row("path length", f"{report.path_length_m:.2f} m")
    if report.reference_length_m is not None:
        off = 100 * (report.path_length_m / report.reference_length_m - 1)
        table.add_row("reference length", f"{report.reference_length_m:.1f} m (ours {off:+.2f} %)")
    if report.error is not None:
        e = report.error
        table.add_row("reference", f"{report.reference_source}, {e.length_m:.2f} m, {e.compared} poses")
        table.add_row("ATE (2D)", f"{e.ate_m:.3f} m ({e.ate_flat_m:.3f} m)")
        table.add_row("RPE over 1 s", f"{e.rpe_m:.3f} m")
        table.add_row("error at the end", f"{e.end_m:.3f} m")
    table.add_row("points that fit the map", f"{100 * report.inlier_fraction:.0f} %")
    table.add_row("CPU per scan", f"{report.cpu_ms_per_scan:.1f} ms")
    return table
