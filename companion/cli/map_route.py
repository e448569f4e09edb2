"""`companion map roadmap` and `companion map route`: many ways through one saved map."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated

import msgspec
import numpy as np
import typer
from rich.console import Console

from companion.cli.bus_options import Json, say
from companion.config import Config
from companion.core.errors import InputError
from companion.core.messages import Array
from companion.runtime.map_file import map_path, read_map, write_map
from companion.runtime.map_roadmap import roadmap_of, whole_space, with_roadmap

_File = Annotated[Path, typer.Argument(help="A map (.umap), or the folder of a flight.")]
_Clearance = Annotated[float, typer.Option(min=0, max=20, help="From the hull to what is occupied, m.")]


class Way(msgspec.Struct, frozen=True, kw_only=True):
    """An answer of `companion map route`."""

    solved: bool
    length_m: float | None
    cpu_ms: float
    """Of the query alone."""
    expanded: int
    places: int
    """Of the roadmap."""
    path: list[tuple[float, float, float]]


def roadmap(
    file: _File,
    samples: Annotated[int, typer.Option(min=10, max=200_000, help="Places of the roadmap.")] = 3000,
    clearance: _Clearance = 0.4,
    seed: Annotated[int, typer.Option(min=0, help="Same seed, same bytes.")] = 0,
) -> None:
    """Build a roadmap (PRM*) in the free space of FILE and keep it there. Example: companion map roadmap flights/demo

    `companion map route` asks it for ways. Unknown space counts as blocked.
    """
    path = map_path(file)
    if path.suffix.lower() != ".umap":
        raise InputError("only .umap keeps a roadmap", file=str(path), valid="companion map convert FILE x.umap")
    stored_map = read_map(path)
    space = whole_space(stored_map, radius_m=Config().hull_radius_m + clearance)
    answer = with_roadmap(stored_map, space, samples=samples, seed=seed)
    size = write_map(path, answer)
    edges = len(roadmap_of(answer).after) // 2
    text = f"{path}  {samples} places, {edges} edges, {size:,} bytes"
    Console(highlight=False, soft_wrap=True).print(text, markup=False)


def route(
    file: _File,
    start: Annotated[str, typer.Option("--from", help="x,y,z in the map's frame, m.")],
    goal: Annotated[str, typer.Option("--to", help="x,y,z in the map's frame, m.")],
    clearance: _Clearance = 0.4,
    as_json: Json = False,
) -> None:
    """Ask FILE's roadmap for a way. Example: companion map route flights/demo --from 0,0,2 --to 15,8,2

    Exit code 1: there is none along the roadmap.
    """
    ends = _place(start, "--from"), _place(goal, "--to")
    stored_map = read_map(file)
    roads = roadmap_of(stored_map)
    space = whole_space(stored_map, radius_m=Config().hull_radius_m + clearance)
    for name, end in zip(("--from", "--to"), ends, strict=True):
        if not space.contains(end) or not space.free(end[None])[0]:
            low, high = (", ".join(f"{v:.1f}" for v in corner) for corner in space.bounds)
            raise InputError(f"{end.tolist()} is not free", field=name, valid=f"free places between {low} and {high}")
    roads.query(*ends, space)  # compiled, if it was not
    began = time.process_time_ns()
    plan = roads.query(*ends, space)
    cpu_ms = (time.process_time_ns() - began) * 1e-6
    way = Way(
        solved=plan.solved,
        length_m=round(plan.cost_m, 3) if plan.solved else None,
        cpu_ms=round(cpu_ms, 3),
        expanded=plan.iterations,
        places=len(roads.points),
        path=[(round(x, 3), round(y, 3), round(z, 3)) for x, y, z in plan.path.tolist()],
    )
    _print(way, as_json=as_json)
    raise typer.Exit(0 if plan.solved else 1)


def _print(way: Way, *, as_json: bool) -> None:
    console = Console(highlight=False, soft_wrap=True)
    if as_json or not console.is_terminal:
        say(msgspec.json.encode(way).decode())
        return
    console.print(f"{way.length_m} m" if way.solved else "no way along the roadmap", markup=False)
    console.print(f"{way.cpu_ms} ms CPU, {way.expanded} of {way.places} places expanded", markup=False)
    for x, y, z in way.path:
        console.print(f"{x:9.2f} {y:9.2f} {z:9.2f}", markup=False)


def _place(text: str, option: str) -> Array:
    """'1,2,3' -> (3,)."""
    try:
        numbers = np.array([float(part) for part in text.split(",")])
    except ValueError:
        numbers = np.empty(0)
    if numbers.shape != (3,) or not np.isfinite(numbers).all():
        raise InputError(f"{text!r} is no place", field=option, valid="x,y,z in m, such as 12.5,-3,2")
    return numbers
