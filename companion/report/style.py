"""One house style for every picture: light, colour-blind safe, readable at 800 px."""

from __future__ import annotations

from typing import Any

import matplotlib

matplotlib.use("Agg")

from matplotlib import pyplot as plt
from matplotlib.axes import Axes

# Okabe and Ito, "Color Universal Design", 2008.
BLACK, ORANGE, SKY, GREEN, YELLOW, BLUE, VERMILION, PURPLE = (
    "#000000", "#E69F00", "#56B4E9", "#009E73", "#F0E442", "#0072B2", "#D55E00", "#CC79A7",
)  # fmt: skip
TRUNK, GROUND = "#8C7B6B", "#D9D2C5"

STYLE: Any = {
    "font.size": 9,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.titlesize": 10,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "legend.frameon": False,
    "legend.fontsize": 8,
    "savefig.dpi": 150,
    "figure.facecolor": "white",
}


def apply() -> None:
    """Use the house style from here on."""
    plt.rcParams.update(STYLE)


def north_arrow(axes: Axes) -> None:
    """Mark north, +y of ENU, in the upper right corner."""
    axes.annotate(
        "N",
        xy=(0.965, 0.985),
        xytext=(0.965, 0.90),
        xycoords="axes fraction",
        ha="center",
        va="top",
        fontsize=9,
        arrowprops={"arrowstyle": "-|>", "color": BLACK, "lw": 1.2},
    )


def scale_bar(axes: Axes, length_m: float) -> None:
    """A bar of the given length in the lower left corner of an equal-aspect map in metres."""
    (x0, x1), (y0, y1) = axes.get_xlim(), axes.get_ylim()
    x, y = x0 + 0.03 * (x1 - x0), y0 + 0.035 * (y1 - y0)
    axes.plot([x, x + length_m], [y, y], color=BLACK, lw=2.5, solid_capstyle="butt", zorder=9)
    axes.text(x + length_m / 2, y + 0.012 * (y1 - y0), f"{length_m:g} m", ha="center", va="bottom", fontsize=8)
