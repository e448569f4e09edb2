"""A map as a picture: its occupied voxels at an angle, from above and from the side."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib import colormaps
from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from companion.core.errors import InputError
from companion.core.messages import Array
from companion.mapping.formats.grid import Grid2D, ground_height
from companion.mapping.formats.stored_map import StoredMap
from companion.mapping.rays import BLOCK
from companion.report import style
from companion.report.voxel_render import ABOVE, NORTHWARD, OBLIQUE, Picture, render

_HERO_PX, _SMALL_PX = 2600, 1500
_WIDTH_IN, _PANE_IN, _LEFT_IN, _RIGHT_IN = 9.0, 3.85, 0.6, 5.0
_HEAD_IN, _FOOT_IN, _SCALE_IN = 0.9, 0.55, 0.95
_GROUND_M = 0.35  # what is lower is drawn in the colour of the ground
_COLORS = "viridis"


def draw_map(stored: StoredMap, path: Path, title: str) -> None:
    """Write the picture (.png, .jpg, .svg, .pdf); InputError if nothing in the map is occupied."""
    centers, _ = stored.occupied()
    if len(centers) == 0:
        raise InputError("no voxel is occupied: there is nothing to draw", field="map")
    style.apply()
    height, label = _height(stored, centers)
    norm = Normalize(0.0, max(float(np.percentile(height, 99.5)), 4 * stored.resolution_m))
    colors = colormaps[_COLORS](norm(height))[:, :3]
    colors[height < _GROUND_M] = _rgb(style.GROUND)
    hero, above, side = (
        render(centers, colors, stored.resolution_m, view, width)
        for view, width in ((OBLIQUE, _HERO_PX), (ABOVE, _SMALL_PX), (NORTHWARD, _SMALL_PX))
    )
    figure = _lay_out((hero, above, side), (ScalarMappable(norm, _COLORS), label))
    figure.text(_LEFT_IN / _WIDTH_IN, 1.0 - 0.12 / figure.get_figheight(), title, va="top", fontsize=10)
    figure.savefig(path)
    plt.close(figure)


def draw_grid(grid: Grid2D, path: Path, title: str) -> None:
    """Write a picture of a 2D grid: free light, occupied dark, unknown in the colour of the page's edge."""
    style.apply()
    size = np.array(grid.probability.shape) * grid.resolution_m
    tall = float(np.clip(5.8 * size[1] / size[0], 2.0, 9.0))
    figure, axes = plt.subplots(figsize=(7.0, tall + 0.8), layout="constrained")
    x, y = grid.origin_xy
    extent = (x, x + size[0], y, y + size[1])
    axes.set_facecolor(style.GROUND)
    shades = np.ma.masked_invalid(grid.probability.T)
    shown = axes.imshow(shades, cmap="Greys", vmin=0.0, vmax=1.0, origin="lower", extent=extent, interpolation="none")
    axes.set(xlabel="east, m", ylabel="north, m", title=title)
    figure.colorbar(shown, ax=axes, label="P(occupied)", shrink=0.7)
    figure.savefig(path)
    plt.close(figure)


def _height(stored: StoredMap, centers: Array) -> tuple[Array, str]:
    """Height (N,) of points above the ground, m, and what it is called; above the lowest if none is seen."""
    try:
        ground = ground_height(stored)
    except InputError:
        return centers[:, 2] - centers[:, 2].min(), "height above the lowest voxel, m"
    corner = BLOCK * stored.block_xyz[:, :2].astype(np.int64).min(axis=0)
    x, y = (np.floor(centers[:, :2] / stored.resolution_m).astype(np.int64) - corner).T
    return np.maximum(centers[:, 2] - ground[x, y], 0.0), "height above ground, m"


def _lay_out(pictures: tuple[Picture, Picture, Picture], scale: tuple[ScalarMappable, str]) -> Figure:
    """The figure: at an angle over the whole width; below it from above, and beside that from the side."""
    hero, above, side = pictures
    hero_size, above_size, side_size = (
        _size(hero, _WIDTH_IN - 0.4, 6.0),
        _size(above, _PANE_IN, 5.5),
        _size(side, _PANE_IN, 4.0),
    )
    low = max(above_size[1], side_size[1] + _SCALE_IN)
    height = low + hero_size[1] + _FOOT_IN + _HEAD_IN
    figure = plt.figure(figsize=(_WIDTH_IN, height))

    def pane(x: float, y: float, size: tuple[float, float]) -> Axes:
        return figure.add_axes((x / _WIDTH_IN, y / height, size[0] / _WIDTH_IN, size[1] / height))

    axes = pane((_WIDTH_IN - hero_size[0]) / 2, height - _HEAD_IN / 2 - hero_size[1], hero_size)
    _show(axes, hero)
    axes.set_axis_off()
    axes = pane(_LEFT_IN, _FOOT_IN + low - above_size[1], above_size)
    _show(axes, above)
    axes.set(xlabel="east, m", ylabel="north, m", title="From above")
    axes = pane(_RIGHT_IN, _FOOT_IN + low - side_size[1], side_size)
    _show(axes, side)
    axes.set(xlabel="east, m", ylabel="up, m", title="From the south")
    bar = pane(_RIGHT_IN, _FOOT_IN + low - side_size[1] - _SCALE_IN, (side_size[0], 0.14))
    figure.colorbar(scale[0], cax=bar, label=scale[1], orientation="horizontal")
    return figure


def _size(picture: Picture, most_wide: float, most_high: float) -> tuple[float, float]:
    """Width and height of a pane, inches, that the picture fills."""
    left, right, bottom, top = picture.extent
    per_m = min(most_wide / (right - left), most_high / (top - bottom))
    return (right - left) * per_m, (top - bottom) * per_m


def _show(axes: Axes, picture: Picture) -> None:
    axes.imshow(picture.rgba, extent=picture.extent, interpolation="antialiased")


def _rgb(color: str) -> tuple[float, ...]:
    return tuple(int(color[k : k + 2], 16) / 255 for k in (1, 3, 5))
