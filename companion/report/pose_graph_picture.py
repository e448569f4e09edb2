"""A pose graph before and after, from above: the way, its closures, and those that were refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from numpy.typing import NDArray

from companion.estimation.pose_graph.graph import PoseGraph
from companion.report.style import BLUE, GREEN, VERMILION, apply

_MOST_LINES = 4000  # a picture shows no more than these


def draw_pose_graph(before: PoseGraph, after: PoseGraph, refused: NDArray[np.int64], path: Path) -> None:
    """Write the picture (.png, .svg, .pdf); `refused` are edges of the graph."""
    apply()
    figure, panes = plt.subplots(1, 2, figsize=(8.5, 4.4), layout="constrained")
    for axes, graph, title in zip(panes, (before, after), ("As measured", "Optimised"), strict=True):
        _draw(axes, graph, refused)
        axes.set_title(title)
    figure.savefig(path)
    plt.close(figure)


def _draw(axes: Axes, graph: PoseGraph, refused: NDArray[np.int64]) -> None:
    places = graph.poses[:, :2]
    chain = graph.consecutive
    wrong = np.isin(np.arange(len(chain)), refused)
    for chosen, color, width, label in (
        (~chain & ~wrong, GREEN, 0.4, "closures"),
        (wrong, VERMILION, 0.4, "refused"),
        (chain, BLUE, 0.9, "way"),
    ):
        edges = np.flatnonzero(chosen)[:: max(int(chosen.sum()) // _MOST_LINES, 1)]
        if len(edges):
            lines = [places[pair] for pair in graph.ends[edges]]
            axes.add_collection(LineCollection(lines, colors=color, linewidths=width, label=label))
    axes.set_aspect("equal")
    axes.autoscale_view()
    axes.set_xlabel("x, m")
    axes.set_ylabel("y, m")
    axes.legend(loc="best")
