"""`companion map`: what a map file holds, other formats of it, 2D grids, and a picture."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any, cast

import msgspec
import typer
from rich.console import Console
from rich.progress import Progress as Bar

from companion.core.errors import InputError
from companion.mapping.formats.facts import MapFacts, facts_of
from companion.mapping.formats.grid import Grid2D, ground_height, occupancy_grid
from companion.mapping.formats.map_server import MODES, Mode, image_of, suffix_of, yaml_of
from companion.mapping.formats.stored_map import StoredMap
from companion.mapping.formats.umap import Progress
from companion.runtime.map_file import READABLE, WRITABLE, check_writable, map_path, read_map, write_file, write_map

_File = Annotated[Path, typer.Argument(help=f"A map ({', '.join(READABLE)}), or the folder of a flight.")]
_PICTURES = (".png", ".jpg", ".svg", ".pdf")


def info(
    file: _File,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
) -> None:
    """Say what FILE holds, and try its checksum. Example: companion map info flights/demo"""
    more, facts = _facts(file)
    if as_json:
        typer.echo(msgspec.json.encode(more | msgspec.structs.asdict(facts)).decode())
        return
    Console(highlight=False, soft_wrap=True).print(_text(more, facts), markup=False)


def info_text(file: Path) -> str:
    """What `info` prints."""
    return _text(*_facts(file))


def convert(
    file: _File,
    out: Annotated[Path, typer.Argument(help=f"The file to write; its suffix says what: {', '.join(WRITABLE)}.")],
) -> None:
    """Write the map in FILE as another format. Example: companion map convert flights/demo forest.bt

    `.ply` and `.pcd` hold the centres of the occupied voxels alone.
    """
    check_writable(out)
    stored = _read(file)
    with _progress(f"writing {out.name}") as on_progress:
        size = write_map(out, stored, on_progress=on_progress)
    Console(highlight=False, soft_wrap=True).print(f"{out}  {size:,} bytes", markup=False)


def slice_(
    file: _File,
    out: Annotated[Path, typer.Option(help="Name without suffix: NAME.pgm, NAME.yaml and NAME.png are written.")],
    z: Annotated[float | None, typer.Option(help="Height of the slice, m; or use --from and --to.")] = None,
    band: Annotated[float, typer.Option(help="Its thickness, m; 0: one layer of voxels.")] = 0.0,
    low: Annotated[float | None, typer.Option("--from", help="Bottom of the band, m.")] = None,
    high: Annotated[float | None, typer.Option("--to", help="Top of the band, m.")] = None,
    above_ground: Annotated[bool, typer.Option("--above-ground", help="Heights count from the ground seen.")] = False,
    mode: Annotated[str, typer.Option(help=f"How map_server is to read the image: {', '.join(MODES)}.")] = "trinary",
) -> None:
    """Write a height band of the map as a 2D grid for ROS' map_server and Nav2, and as a picture.

    Example: companion map slice flights/demo --from 0.5 --to 2 --above-ground --out forest
    """
    span = _span(z, band, low, high)
    suffix = suffix_of(cast(Mode, mode))
    stored = _read(file)
    with _progress("cutting") as _:
        ground_z = ground_height(stored) if above_ground else None
        grid = occupancy_grid(stored, *span, ground_z=ground_z)
    _write_grid(grid, out, cast(Mode, mode), suffix, _span_text(span, above_ground))


def view(
    file: _File,
    out: Annotated[Path, typer.Option(help=f"The picture to write ({', '.join(_PICTURES)}).")],
) -> None:
    """Draw the map at an angle, from above and from the side. Example: companion map view flights/demo --out map.png"""
    from companion.report.map_picture import draw_map

    if out.suffix.lower() not in _PICTURES:
        raise InputError(f"no picture by its name: {out.name}", field="--out", valid=", ".join(_PICTURES))
    stored = _read(file)
    facts = facts_of(stored)
    size = " x ".join(f"{v:.0f}" for v in facts.size_m)
    title = f"{map_path(file)}: {size} m in voxels of {stored.resolution_m:g} m, {facts.occupied_voxels:,} occupied"
    with _progress("drawing") as _, _naming(out):
        draw_map(stored, out, title)
    Console(highlight=False, soft_wrap=True).print(str(out), markup=False)


def _read(file: Path) -> StoredMap:
    with _progress(f"reading {file.name}") as on_progress:
        return read_map(file, on_progress=on_progress)


def _facts(file: Path) -> tuple[dict[str, Any], MapFacts]:
    path = map_path(file)
    facts = facts_of(_read(path))
    checksum = "ok" if path.suffix.lower() == ".umap" else "none in this format"
    return {"file": str(path), "bytes": path.stat().st_size, "checksum": checksum}, facts


def _text(more: dict[str, Any], facts: MapFacts) -> str:
    return "\n".join(f"{name:<14}{text}" for name, text in _rows(more, facts).items())


def _rows(more: dict[str, Any], facts: MapFacts) -> dict[str, str]:
    box = ", ".join(
        f"{axis} {low:.1f} to {high:.1f} m" for axis, low, high in zip("xyz", facts.low_m, facts.high_m, strict=True)
    )
    model = facts.sensor
    return {
        "file": f"{more['file']}  {more['bytes']:,} bytes",
        "checksum": more["checksum"],
        "made by": facts.created_by or "not said",
        "resolution": f"{facts.resolution_m:g} m",
        "frame": facts.frame,
        "extent": box if facts.blocks else "empty",
        "occupied": f"{facts.occupied_m3:,.1f} m3  {facts.occupied_voxels:,} voxels",
        "free": f"{facts.free_m3:,.1f} m3  {facts.free_voxels:,} voxels",
        "known": f"{facts.known_m3:,.1f} m3",
        "blocks": f"{facts.blocks:,} of 8^3 voxels",
        "sensor model": f"hit {model.hit:g}, miss {model.miss:g}, within {model.lowest:g} to {model.highest:g}",
        "sections": ", ".join(f"{name} ({size:,} bytes)" for name, size in facts.sections.items()) or "none besides",
    }


def _span(z: float | None, band: float, low: float | None, high: float | None) -> tuple[float, float]:
    if z is not None and low is None and high is None:
        if not 0.0 <= band < float("inf"):
            raise InputError(f"{band} m", field="--band", valid="0 or more")
        return z - band / 2, z + band / 2
    if z is None and low is not None and high is not None:
        return low, high
    raise InputError("which heights?", field="--z", valid="--z Z [--band B], or --from A --to B")


def _span_text(span: tuple[float, float], above_ground: bool) -> str:
    heights = f"{span[0]:g} m" if span[0] == span[1] else f"{span[0]:g} to {span[1]:g} m"
    return f"Occupancy at {heights} {'above ground' if above_ground else 'of height'}"


def _write_grid(grid: Grid2D, out: Path, mode: Mode, suffix: str, title: str) -> None:
    from companion.report.map_picture import draw_grid

    image = out.with_name(out.name + suffix)
    picture = out.with_name(out.name + ("_picture.png" if suffix == ".png" else ".png"))
    facts = out.with_name(out.name + ".yaml")
    write_file(image, image_of(grid, mode))
    write_file(facts, yaml_of(grid, image.name, mode).encode())
    with _naming(picture):
        draw_grid(grid, picture, title)
    width, height = grid.probability.shape
    console = Console(highlight=False, soft_wrap=True)
    console.print(f"{image}  {width} x {height} cells of {grid.resolution_m:g} m", markup=False)
    for path in (facts, picture):
        console.print(str(path), markup=False)


@contextmanager
def _naming(path: Path) -> Iterator[None]:
    """Says which picture could not be written."""
    try:
        yield
    except OSError as error:
        raise InputError(error.strerror or "cannot be written", file=str(path), valid="a place to write to") from error


@contextmanager
def _progress(label: str) -> Iterator[Progress]:
    """A bar on standard error, gone when the work is done."""
    console = Console(stderr=True)
    with Bar(console=console, transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task(label, total=1.0)
        yield lambda share: bar.update(task, completed=share)
