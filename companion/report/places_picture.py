"""Loop closures on the map: the way as odometry had it, and as the closures put it, beside the truth."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from numpy.typing import NDArray

from companion.core.messages import Array
from companion.report import style


def draw_loops(
    path: Path, title: str, ways: tuple[Array, Array, Array], closures: NDArray[np.int64], seen: tuple[Array, Array]
) -> None:
    """Write `path` (PNG).

    `ways` are keyframes (K, 3) by odometry, corrected, and true, m, each starting at the same pose;
    `closures` (C, 2) pairs of keyframes; `seen` the points (N, 3) of all submaps, where odometry and
    where the corrected poses put them.
    """
    style.apply()
    figure, panes = plt.subplots(1, 2, figsize=(10.0, 5.0), layout="constrained", sharex=True, sharey=True)
    for axes, way, points, name in zip(panes, ways[:2], seen, ("By odometry", "With closures"), strict=True):
        axes.plot(points[:, 0], points[:, 1], ",", color=style.TRUNK, alpha=0.25, zorder=1)
        axes.plot(*ways[2][:, :2].T, color=style.BLACK, lw=2.2, label="truth", zorder=2)
        axes.plot(*way[:, :2].T, color=style.BLUE, lw=1.2, label="keyframes", zorder=3)
        _closures(axes, way, closures)
        error_m = float(np.sqrt(np.mean(np.sum((way - ways[2]) ** 2, axis=1))))
        axes.set(aspect="equal", xlabel="east, m", ylabel="north, m", title=f"{name}: {error_m:.2f} m rms")
    panes[0].legend(loc="upper right")
    figure.suptitle(title, x=0.01, ha="left", fontsize=10)
    figure.savefig(path)
    plt.close(figure)


def _closures(axes: Axes, way: Array, closures: NDArray[np.int64]) -> None:
    lines = [way[pair, :2] for pair in closures]
    axes.add_collection(LineCollection(lines, colors=style.VERMILION, lw=1.0, label="closures", zorder=4))
