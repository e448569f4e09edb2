"""One picture of the planners: the same plane world, what each searched, and the way that it found."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection

from companion.core.messages import Array
from companion.planning.lattice.planner import AStar
from companion.planning.planner import Plan, Planner
from companion.planning.roadmap import PRM
from companion.planning.rrt import RRT, RRTConnect
from companion.planning.rrt_star import RRTStar
from companion.report import style
from companion.runtime.bench.planners import plan_once, planner_for, shortest_known
from companion.runtime.bench.planners_worlds import World

_COLUMNS = 4
_CAPTION = (
    "{title}, seen by a vehicle of 0.4 m radius. Shaded: expanded cells, the last darkest. Thin lines: trees and"
    " roadmaps. Length against the shortest way known."
)
_LATE = 0.75  # share of the colour map that the last expanded cell has
_MOST_EDGES, _MANY_EDGES = 20_000, 5000


def draw_planners(world: World, planners: Sequence[str], file: Path, *, pair: int = 0, seed: int = 0) -> None:
    """Write the picture of a plane world (PNG, or what the file's ending says)."""
    style.apply()
    rows = -(-len(planners) // _COLUMNS)
    figure, grid = plt.subplots(
        rows, min(_COLUMNS, len(planners)), figsize=(2.75 * min(_COLUMNS, len(planners)), 3.25 * rows), squeeze=False
    )
    best = shortest_known(world, pair)
    for axes, name in zip(grid.flat, planners, strict=False):
        machine = planner_for(name, world)
        plan = plan_once(machine, name, world, pair, seed=seed)
        _world(axes, world)
        _search(axes, machine, world)
        _way(axes, plan, world.ends[pair])
        found = f"{plan.cost_m:.1f} m, {100 * (plan.cost_m / best - 1):+.1f} %" if plan.solved else "no way found"
        unit = "cells" if isinstance(machine, AStar) else "samples"
        axes.set_title(name, fontsize=10, pad=14)
        axes.text(0.0, 1.02, f"{found}; {plan.iterations} {unit}", transform=axes.transAxes, fontsize=7.5)
    for axes in list(grid.flat)[len(planners) :]:
        axes.set_visible(False)
    figure.tight_layout(h_pad=1.6, w_pad=0.4, rect=(0, 0.02, 1, 1))
    figure.text(0.012, 0.012, _CAPTION.format(title=world.title), fontsize=7.5)
    figure.savefig(file)
    plt.close(figure)


def _world(axes: Axes, world: World) -> None:
    """Blocked cells; the axes in m, without ticks."""
    low, high = world.space.bounds
    blocked = np.ma.masked_equal((world.space.steps[:, :, 0] == 0).T, False)
    axes.imshow(
        blocked, cmap="Greys", vmin=0, vmax=1.6, origin="lower", extent=(low[0], high[0], low[1], high[1]), zorder=3
    )
    axes.set_xlim(low[0], high[0])
    axes.set_ylim(low[1], high[1])
    axes.set_aspect("equal")
    axes.set_xticks([])
    axes.set_yticks([])
    for side in axes.spines.values():
        side.set_visible(True)
        side.set_color("#999999")
        side.set_linewidth(0.6)


def _search(axes: Axes, machine: Planner, world: World) -> None:
    """Cells in the order of their expansion, or edges of trees and roadmaps."""
    if isinstance(machine, AStar):
        order = np.full(world.space.steps.shape[:2], np.nan)
        order[machine.closed[:, 0], machine.closed[:, 1]] = np.linspace(0.0, _LATE, len(machine.closed))
        low, high = world.space.bounds
        options: dict[str, Any] = {"cmap": "Blues", "vmin": -0.35, "vmax": 1.2, "origin": "lower", "zorder": 1}
        axes.imshow(order.T, extent=(low[0], high[0], low[1], high[1]), interpolation="nearest", **options)
        return
    edges = _edges(machine)[:, :, :2]
    edges = edges[:: max(1, len(edges) // _MOST_EDGES)]
    width = 0.7 if len(edges) < _MANY_EDGES else 0.25
    axes.add_collection(LineCollection(list(edges), colors=style.BLUE, linewidths=width, alpha=0.7, zorder=2))


def _edges(machine: Planner) -> Array:
    """(E, 2, 3), m; none for a planner that keeps none."""
    if isinstance(machine, RRT | RRTConnect | RRTStar):
        return machine.edges()
    if isinstance(machine, PRM) and machine.roadmap is not None:
        roadmap = machine.roadmap
        before = np.repeat(np.arange(len(roadmap.points)), np.diff(roadmap.first))
        once = before < roadmap.after
        return np.stack([roadmap.points[before[once]], roadmap.points[roadmap.after[once]]], axis=1)
    return np.empty((0, 2, 3))


def _way(axes: Axes, plan: Plan, ends: Array) -> None:
    if plan.solved:
        axes.plot(plan.path[:, 0], plan.path[:, 1], color="white", lw=3.2, zorder=4)
        axes.plot(plan.path[:, 0], plan.path[:, 1], color=style.VERMILION, lw=1.8, zorder=5)
    for end, marker, colour in zip(ends, "os", (style.GREEN, style.BLACK), strict=True):
        axes.plot(end[0], end[1], marker, color=colour, ms=6, mec="white", mew=0.8, zorder=6)
