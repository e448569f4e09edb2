"""Opens the simulator for a flight: world, renderer, node, and what the report wants of them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
from rich.console import Console

from companion.config import apply_overrides_to, dump_struct
from companion.core.messages import Array
from companion.report.flight_figure import Scenery
from sim.config import SimConfig
from sim.node import SimNode
from sim.sensors.render import InlineRenderer, NoRenderer, Renderer, WorkerRenderer
from sim.world import World, load_world

_OUTLINE_M = 1.0  # above ground: where a picture from above cuts the walls


@dataclass(frozen=True, slots=True)
class Simulator:
    """A world in which vehicles fly, one at a time."""

    world: World
    config: SimConfig
    renderer: Renderer
    seed: int

    def new_node(self, *, signing_key: bytes | None = None) -> SimNode:
        """The vehicle at the start, as a node."""
        return SimNode(self.config, self.world, self.renderer, seed=self.seed, signing_key=signing_key)

    def cpu_s(self, node_cpu_s: float) -> dict[str, float]:
        """CPU seconds per part of the simulator, each counted once wherever rendering ran."""
        rendered = self.renderer.cpu_s
        inline = sum(rendered.values()) if isinstance(self.renderer, InlineRenderer) else 0.0
        return {"SimNode": node_cpu_s - inline, **rendered}

    def describe(self) -> str:
        """The simulator's configuration as YAML."""
        return dump_struct(self.config, root="sim")


def scenery_of(world: World) -> Scenery:
    """The world as the picture of a flight shows it."""
    nx, ny = world.heights.shape
    stems = world.stems
    return Scenery(
        stem_xy=np.column_stack([stems.x, stems.y]),
        stem_diameter_m=stems.dbh_m,
        stem_base_z=stems.z_ground,
        stem_height_m=stems.height_m,
        contour_x=world.origin_xy[0] + world.cell_m * np.arange(nx),
        contour_y=world.origin_xy[1] + world.cell_m * np.arange(ny),
        ground_z=world.heights,
        wall_xy=_outline(world),
    )


def _outline(world: World) -> Array:
    """Where walls cross the height of flight, from above: segments (S, 2, 2), m."""
    corners = world.walls.corners
    xy = corners[..., :2]
    above = corners[..., 2] - world.ground_z(xy[..., 0], xy[..., 1]) - _OUTLINE_M
    ends = []
    for a, b in ((0, 1), (1, 2), (2, 0)):
        crosses = (above[:, a] < 0) != (above[:, b] < 0)
        share = above[:, a] / np.where(crosses, above[:, a] - above[:, b], np.nan)
        ends.append(xy[:, a] + share[:, None] * (xy[:, b] - xy[:, a]))
    points = np.stack(ends, axis=1)
    crossed = np.isfinite(points[..., 0])
    two = crossed.sum(axis=1) == 2
    return np.asarray(points[two][crossed[two]].reshape(-1, 2, 2))


@contextmanager
def open_simulator(
    world: str,
    seed: int,
    overrides: Sequence[str],
    workers: int,
    console: Console,
    *,
    most_waiting: int | None = None,
) -> Iterator[Simulator]:
    """Build world and renderer, warm both up, and close what was opened.

    A worker that is `most_waiting` requests behind leaves sweeps and frames out.
    """
    own = [o.removeprefix("sim.") for o in overrides if o.startswith("sim.")]
    config = apply_overrides_to(SimConfig(), own, root="sim")
    with console.status(f"building world {world}, seed {seed}"):
        built = load_world(world, seed=seed)
    renderer = _renderer(config, built, seed, workers=workers, most_waiting=most_waiting)
    try:
        yield Simulator(built, config, renderer, seed)
    finally:
        renderer.close()


def _renderer(config: SimConfig, world: World, seed: int, *, workers: int, most_waiting: int | None) -> Renderer:
    if not config.render:
        return NoRenderer()
    sensors = config.lidar, config.camera, config.rig
    if not workers:
        return InlineRenderer(world, *sensors, seed=seed)
    return WorkerRenderer(world, *sensors, seed=seed, most_waiting=most_waiting)
