"""The picture of a flight: from above, from the side, and the estimate's error over time."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from matplotlib.collections import EllipseCollection, LineCollection
from matplotlib.figure import Figure

from companion.core.messages import Array
from companion.report import style
from companion.report.summary import aligned
from companion.report.tracks import Track, Tracks

_FLAT_M = 0.1  # a floor this even has no contour lines


@dataclass(frozen=True, slots=True, kw_only=True)
class Scenery:
    """What the map shows beside the flight; the caller takes it from the simulated world."""

    stem_xy: Array  # m, (K, 2)
    stem_diameter_m: Array  # (K,)
    stem_base_z: Array  # (K,)
    stem_height_m: Array  # (K,)
    contour_x: Array  # (X,)
    contour_y: Array  # (Y,)
    ground_z: Array  # (X, Y)
    wall_xy: Array = field(default_factory=lambda: np.empty((0, 2, 2)))  # where walls cross the height of flight


def draw_flight(path: Path, tracks: Tracks, scenery: Scenery, title: str) -> None:
    """Write `path` (PNG): trunks to scale, true path dark, estimate coloured by its error."""
    style.apply()
    estimate, truth = aligned(tracks.map_track(), tracks.true_track())
    figure = plt.figure(figsize=(9.0, 9.6), layout="constrained")
    grid = figure.add_gridspec(3, 1, height_ratios=[5.2, 1.5, 1.1])
    above, side, error = (figure.add_subplot(grid[k]) for k in range(3))
    _from_above(figure, above, tracks, scenery, estimate, truth)
    _from_side(side, tracks, scenery, estimate, truth)
    _error_over_time(error, tracks, estimate, truth)
    figure.suptitle(title, x=0.01, ha="left", fontsize=10)
    figure.savefig(path)
    plt.close(figure)


def headline(mission: str, world: str, seed: int, failure: str, figures: Mapping[str, float]) -> str:
    """What a flight came to, in a line or two; `figures` as of `trajectory_figures`."""
    outcome = f"not completed: {failure}" if failure else "completed"
    return (
        f"{mission} in {world}, seed {seed}: {outcome}. "
        f"{figures['path_length_m']:.0f} m at {figures['mean_speed_m_s']:.1f} m/s, hull clearance "
        f"≥ {figures['min_clearance_m']:.2f} m, estimate within {100 * figures['position_rmse_m']:.1f} cm rms"
    )


def _from_above(figure: Figure, axes: Axes, tracks: Tracks, scenery: Scenery, estimate: Track, truth: Track) -> None:
    box = _frame(truth.p, margin=6.0)
    _relief(axes, scenery)
    _trunks(axes, scenery)
    axes.add_collection(LineCollection(list(scenery.wall_xy), colors=style.TRUNK, lw=1.0, zorder=3))
    _plans(axes, tracks, 0, 1)
    axes.plot(truth.p[:, 0], truth.p[:, 1], color=style.BLACK, lw=2.4, label="true path", zorder=4)
    lines = _coloured(axes, estimate, truth, 0, 1)
    if len(truth.p):
        axes.plot(*truth.p[0, :2], "o", ms=8, mfc="white", mec=style.BLACK, label="take-off", zorder=7)
        axes.plot(*truth.p[-1, :2], "s", ms=7, mfc=style.VERMILION, mec=style.BLACK, label="landing", zorder=7)
    axes.set(xlim=box[0], ylim=box[1], aspect="equal", xlabel="east, m", ylabel="north, m", title="From above")
    figure.colorbar(lines, ax=axes, label="estimate's distance to the truth, cm", shrink=0.6, pad=0.01)
    _legend_above(axes)
    style.north_arrow(axes)
    style.scale_bar(axes, 10.0)


def _relief(axes: Axes, scenery: Scenery) -> None:
    if np.ptp(scenery.ground_z) < _FLAT_M:
        return
    relief = axes.contour(
        scenery.contour_x, scenery.contour_y, scenery.ground_z.T, levels=12, colors=style.GROUND, linewidths=0.7
    )
    axes.clabel(relief, fmt="%.1f m", fontsize=6)


def _trunks(axes: Axes, scenery: Scenery) -> None:
    d = scenery.stem_diameter_m
    axes.add_collection(
        EllipseCollection(
            d, d, np.zeros(len(d)), units="xy", offsets=scenery.stem_xy, transOffset=axes.transData,
            facecolors=style.TRUNK, edgecolors=style.BLACK, linewidths=0.3, zorder=3,
        )
    )  # fmt: skip


def _plans(axes: Axes, tracks: Tracks, i: int, j: int) -> None:
    label: str | None = "planned, once per second"
    last_ns = -(10**9)
    for plan in tracks.plans:
        if plan.state == "flying" and len(plan.plan_p_odom) > 1 and plan.stamp_ns - last_ns >= 10**9:
            p = plan.plan_p_odom
            axes.plot(p[:, i], p[:, j], "--", color=style.SKY, lw=0.8, label=label, zorder=2)
            label, last_ns = None, plan.stamp_ns


def _coloured(axes: Axes, estimate: Track, truth: Track, i: int, j: int) -> LineCollection:
    p = estimate.p[::5][:, [i, j]]
    error_cm = 100.0 * np.linalg.norm(estimate.p - truth.p, axis=1)[::5]
    segments = np.stack([p[:-1], p[1:]], axis=1) if len(p) > 1 else np.empty((0, 2, 2))
    lines = LineCollection(list(segments), cmap="viridis", lw=1.2, zorder=5, label="estimate")
    lines.set_array(error_cm[1:])
    axes.add_collection(lines)
    return lines


def _from_side(axes: Axes, tracks: Tracks, scenery: Scenery, estimate: Track, truth: Track) -> None:
    box = _frame(truth.p, margin=6.0)
    near = (scenery.stem_xy[:, 1] > box[1][0]) & (scenery.stem_xy[:, 1] < box[1][1])
    near &= (scenery.stem_xy[:, 0] > box[0][0]) & (scenery.stem_xy[:, 0] < box[0][1])
    for k in np.flatnonzero(near):
        x, r = scenery.stem_xy[k, 0], scenery.stem_diameter_m[k] / 2
        axes.axvspan(x - r, x + r, color=style.TRUNK, alpha=0.25, lw=0)
    x, lowest, highest = _ground_profile(scenery, box)
    axes.fill_between(x, np.full_like(x, lowest.min() - 1.0), lowest, color=style.GROUND, lw=0)
    axes.fill_between(x, lowest, highest, color=style.GROUND, alpha=0.5, lw=0)
    _plans(axes, tracks, 0, 2)
    axes.plot(truth.p[:, 0], truth.p[:, 2], color=style.BLACK, lw=1.8, zorder=4)
    _coloured(axes, estimate, truth, 0, 2)
    top = float(truth.p[:, 2].max()) if len(truth.p) else 3.0
    axes.set(xlim=box[0], ylim=(float(lowest.min()) - 0.5, top + 1.0), xlabel="east, m", ylabel="up, m")
    axes.set_title("From the side, looking north")


def _ground_profile(scenery: Scenery, box: tuple[tuple[float, float], ...]) -> tuple[Array, Array, Array]:
    """East (N,), and the lowest and highest ground that the side view looks through, m."""
    (x0, x1), (y0, y1) = box
    columns = (scenery.contour_x >= x0) & (scenery.contour_x <= x1)
    rows = (scenery.contour_y >= y0) & (scenery.contour_y <= y1)
    ground = scenery.ground_z[columns][:, rows]
    return scenery.contour_x[columns], ground.min(axis=1), ground.max(axis=1)


def _error_over_time(axes: Axes, tracks: Tracks, estimate: Track, truth: Track) -> None:
    error = estimate.p - truth.p
    sigma = np.sqrt([m.pose_variance[3:] for m in tracks.odometry[: len(estimate.t_s)]])
    for k, (axis, colour) in enumerate(zip("xyz", (style.BLUE, style.VERMILION, style.GREEN), strict=True)):
        axes.plot(estimate.t_s, 100 * error[:, k], color=colour, lw=1.0, label=axis)
    if len(sigma):
        worst = 300.0 * sigma.max(axis=1)
        axes.fill_between(estimate.t_s, -worst, worst, color=style.SKY, alpha=0.2, lw=0, label="3 sigma")
        limit = max(3.0, 130 * float(np.abs(error).max()))
        axes.set_ylim(-limit, limit)
    axes.set(xlabel="time, s", ylabel="error, cm", title="Estimate minus truth")
    _legend_above(axes)


def _legend_above(axes: Axes) -> None:
    """Beside the title, where it hides no data."""
    axes.legend(loc="lower right", bbox_to_anchor=(1.0, 0.99), ncols=6, frameon=False, borderpad=0.0)


def _frame(p: Array, *, margin: float) -> tuple[tuple[float, float], tuple[float, float]]:
    if not len(p):
        return (-10.0, 10.0), (-10.0, 10.0)
    low, high = p[:, :2].min(axis=0) - margin, p[:, :2].max(axis=0) + margin
    return (float(low[0]), float(high[0])), (float(low[1]), float(high[1]))


def figure_of(value: Any) -> str:
    """One table cell: digits that mean something."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:.2f}" if isinstance(value, float) else str(value)
