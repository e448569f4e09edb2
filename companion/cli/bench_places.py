"""`companion bench places`: loops and starts in saved maps, in simulated forests, a warehouse and a mine."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.console import Console

from companion.cli.bench_rows import check_out, written
from companion.cli.place_scenes import Eye, Way, drifting_poses, true_poses, way_length, way_through
from companion.core.errors import InputError
from companion.core.geometry import quaternion_from_yaw, rotation_from_quaternion
from companion.core.messages import Array
from companion.core.rig import Rig
from companion.core.topics import REGISTERED
from companion.estimation.places.locate import Locator
from companion.estimation.places.loops import LoopConfig
from companion.mapping.formats.stored_map import stored
from companion.mapping.node import MappingConfig, MappingNode
from companion.report.places_picture import draw_loops
from companion.runtime.bench.places import PlaceRow, View, loop_rows, start_rows
from companion.runtime.map_places import locator_of
from sim.world import World, load_world

Corners = Sequence[Sequence[float]]


def _to_and_fro(low: float, high: float, lines: Iterable[float]) -> list[list[float]]:
    return [[x, float(y)] for k, y in enumerate(lines) for x in ((low, high), (high, low))[k % 2]]


_FOREST = "poisson,size_m=220,stems_per_ha=300,leaves=20"
_AISLES: list[list[float]] = [
    [x, y] for k, y in enumerate((-11.0, -6.6, -2.2, 2.2, 6.6, 11.0)) for x in ((0, 38.6), (38.6, 0))[k % 2]
]
_RINGS: list[list[float]] = [
    [0, 0], [5.3, -9.3], [5.3, -20], [-6, -20.3], [-17.8, -20], [-20, -6.7], [-21.1, 6.2], [-10.4, 3.5], [0, 0],
    [-10.4, 3.5], [-21.1, 6.2], [-32.2, 4.3], [-43.2, 1.6], [-47.3, -10.3], [-46.7, -22.9], [-32.1, -20.8],
    [-17.8, -20], [-6, -20.3], [5.3, -20], [5.3, -9.3], [0, 0],
]  # fmt: skip
_LAP: list[list[float]] = [[18, 0], [30, 18], [18, 36], [-12, 36], [-24, 18], [-12, 0]]
_LANES: list[list[float]] = [
    [x, y] for k, y in enumerate(range(-70, 71, 14)) for x in ((-100, 100), (100, -100))[k % 2]
]
_BACK: list[list[float]] = [[0, 11], [0, 0]]
_VIEWS, _SWEEPS, _SWEEP_STEP_M, _VIEW_STEP_M = 3, 5, 0.2, 1.0
_MAP_NOISE_M = 0.05


@dataclass(frozen=True, slots=True)
class _Asked:
    starts: int
    pictures: Path | None


Scene = Callable[[str, _Asked], list[PlaceRow]]
_DRIFT = {"yaw_per_m": 3e-4, "scale": 1.003, "climb_per_m": 1.5e-3}


def places(
    scenes: Annotated[list[str] | None, typer.Option(help="This scene; give it again for more. None: all.")] = None,
    starts: Annotated[int, typer.Option(min=1, max=1000, help="Starts per map.")] = 100,
    out: Annotated[Path | None, typer.Option(help="Write the rows there, too, one JSON object per line.")] = None,
    pictures: Annotated[Path | None, typer.Option(help="Folder for pictures of the loops.")] = None,
) -> None:
    """Measure how places are known again, as JSON lines. Example: companion bench places --scenes lost-mine --starts 20

    Scenes: laps, rings and aisles (loops with injected drift); lost-forest, lost-elsewhere, lost-warehouse, lost-mine
    (starts in maps that the mapping node built). All of them take some ten minutes.
    """
    for name in scenes or ():
        if name not in _SCENES:
            raise InputError(f"{name!r} is no scene", field="--scenes", valid=", ".join(_SCENES))
    check_out(out)
    if pictures is not None and not pictures.is_dir():
        raise InputError("no such folder", field="--pictures", file=str(pictures))
    for _ in written(_measured(scenes or list(_SCENES), _Asked(starts, pictures)), out=out, plain=True):
        pass


def _measured(names: list[str], asked: _Asked) -> Iterator[PlaceRow]:
    for name in names:
        Console(stderr=True).print(name, style="dim", highlight=False)
        yield from _SCENES[name](name, asked)


def _loops(world: str, corners: Corners, agl_m: float) -> Scene:
    def rows(name: str, asked: _Asked) -> list[PlaceRow]:
        built = load_world(world, seed=4)
        way = way_through(built, np.array(corners, np.float64), spacing_m=0.4, agl_m=agl_m)
        scans = Eye(built, seed=4).registered(way, drifting_poses(way, **_DRIFT, seed=4))
        figures, loops = loop_rows(name, scans, true_poses(way), LoopConfig())
        if asked.pictures is not None:
            title = f"{name}: {way_length(way):.0f} m, {len(loops.closures)} closures, with injected drift"
            draw_loops(asked.pictures / f"loops-{name}.png", title, loops.ways, loops.closures, loops.seen)
        return figures

    return rows


def _lost(
    mapped: str,
    visited: str,
    corners: Corners,
    agl_m: float,
    *,
    seeds: tuple[int, int],
    target: float,
) -> Scene:
    """Starts in `visited` with the map of `mapped`; other seeds are other places."""

    def rows(name: str, asked: _Asked) -> list[PlaceRow]:
        world = load_world(mapped, seed=seeds[0])
        way = way_through(world, np.array(corners, np.float64), spacing_m=1.0, agl_m=agl_m)
        locator = _mapped(world, way, agl_m)
        there = load_world(visited, seed=seeds[1])
        return start_rows(
            name, locator, _starts(there, way, asked.starts, agl_m), known=seeds[0] == seeds[1], target=target
        )

    return rows


def _mapped(world: World, way: Way, agl_m: float) -> Locator:
    """The map that the mapping node makes on the way, each occupied place moved by 5 cm of noise."""
    node = MappingNode(MappingConfig(), Rig(), hull_radius_m=0.35)
    for scan in Eye(world, seed=1).registered(way, true_poses(way)):
        for _ in node.handle(REGISTERED, scan):
            pass
    return locator_of(stored(node.voxels), height_m=agl_m, noise_m=_MAP_NOISE_M, seed=1)


def _starts(world: World, way: Way, count: int, agl_m: float) -> Iterator[list[View]]:
    """Three views of a second each, a metre apart, from places beside the way, along it or against it."""
    rng, eye = np.random.default_rng(5), Eye(world, seed=99)
    for number in range(count):
        k = int(rng.integers(len(way.p)))
        yaw = float(way.yaw[k] + rng.choice([0.0, np.pi]) + rng.normal(0.0, 0.2))
        p = way.p[k] + np.array([*rng.normal(0.0, 0.3, 2), 0.0])
        p[2] = float(world.ground_z(p[0], p[1])) + agl_m
        yield [_view(eye, p, yaw, (number * _VIEWS + n) * _SWEEPS, n) for n in range(_VIEWS)]


def _view(eye: Eye, p_last: Array, yaw: float, counter: int, number: int) -> View:
    """Sweeps on a level way that ends at the view's place, in the body of the newest."""
    R = rotation_from_quaternion(quaternion_from_yaw(yaw))
    p = p_last - R[:, 0] * _VIEW_STEP_M * (_VIEWS - 1 - number)
    seen = []
    for n in range(_SWEEPS):
        back = -_SWEEP_STEP_M * (_SWEEPS - 1 - n)
        points, _ = eye.sweep(p + R[:, 0] * back, yaw, counter + n)
        seen.append(points + np.array([back, 0.0, 0.0], np.float32))
    step = np.array([_VIEW_STEP_M if number else 0.0, 0.0, 0.0])
    return View(np.concatenate(seen), np.eye(3), step, p)


_SCENES: dict[str, Scene] = {
    "laps": _loops("poisson,stems_per_ha=250", _LAP * 4, 2.5),
    "rings": _loops("mine", _RINGS * 2, 1.6),
    "aisles": _loops("warehouse", (_AISLES + _BACK) * 2, 1.6),
    "lost-forest": _lost(_FOREST, _FOREST + ",felled=0.1", _LANES, 2.0, seeds=(4, 4), target=0.98),
    "lost-elsewhere": _lost(_FOREST, _FOREST, _LANES, 2.0, seeds=(4, 55), target=1.0),
    "lost-warehouse": _lost("warehouse", "warehouse", _AISLES + _BACK, 1.6, seeds=(0, 0), target=0.9),
    "lost-mine": _lost("mine", "mine", _RINGS, 1.6, seeds=(0, 0), target=0.9),
}
