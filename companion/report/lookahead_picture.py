"""Picture of a lookahead sweep: nearness, smoothness, responsiveness and stability, one below the other."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from companion.report import style
from companion.runtime.bench.tracking_lookahead import LookaheadRow


def draw_lookahead(rows: Sequence[LookaheadRow], best: LookaheadRow, file: Path) -> None:
    """Write a PNG; the best lookahead is marked in every panel."""
    style.apply()
    figure = Figure(figsize=(7.5, 9.0), layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(4, 1, sharex=True)
    x = [r.lookahead_s for r in rows]
    drawn = (
        ("across the path, m", (("rms", [r.score.rmse_m for r in rows]), ("worst", [r.score.worst_m for r in rows]))),
        ("smoothness: jerk, m/s³", (("rms", [r.score.jerk_m_s3 for r in rows]),)),
        ("responsiveness: late, s", (("flown minus planned", [r.score.late_s for r in rows]),)),
        (
            "stability",
            (
                ("changes of side per m", [r.score.wobble_per_m for r in rows]),
                ("past the end, m", [r.score.past_end_m for r in rows]),
            ),
        ),
    )
    for axes, (title, curves) in zip(panels, drawn, strict=True):
        for name, values in curves:
            axes.plot(x, values, marker="o", markersize=4, label=name)
        axes.axvline(best.lookahead_s, color="0.4", linestyle="--", linewidth=1.0)
        axes.set_ylabel(title)
        low, high = (f(0.0, *(v for _, values in curves for v in values)) for f in (min, max))
        axes.set_ylim(low - 0.05 * (high - low), high + 0.1 * (high - low))
        axes.grid(alpha=0.3)
        axes.legend(loc="best")
    panels[-1].set_xlabel("lookahead, s at the present speed")
    s = best.score
    figure.suptitle(
        f"{best.method} on {best.course}: best {best.lookahead_s:g} s "
        f"({best.lookahead_m:.2f} m at {s.mean_m_s:.1f} m/s), {s.rmse_m:.3f} m rms, {s.worst_m:.3f} m worst"
    )
    figure.savefig(file, dpi=140)
