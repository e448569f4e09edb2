"""`companion graph optimise`: the most likely poses of a pose graph in a g2o file."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated, cast, get_args

import msgspec
import typer
from rich.console import Console

from companion.core.errors import InputError
from companion.estimation.pose_graph.g2o import read_g2o, write_g2o
from companion.estimation.pose_graph.graph import PoseGraph, check
from companion.estimation.pose_graph.optimise import Kernel, OptimiseConfig, Optimised, optimise

_KERNELS = get_args(Kernel)


def optimise_file(
    file: Annotated[Path, typer.Argument(help="A g2o file, in the plane or in space.")],
    kernel: Annotated[
        str, typer.Option(help=f"How closures are doubted: {', '.join(_KERNELS)}. Odometry never is.")
    ] = "l2",
    out: Annotated[Path | None, typer.Option(help="Write the optimised graph here, as g2o.")] = None,
    picture: Annotated[Path | None, typer.Option(help="Write a picture here (.png, .svg, .pdf).")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
) -> None:
    """Optimise the poses of FILE. Example: companion graph optimise loop.g2o --kernel dcs --picture loop.png"""
    if kernel not in _KERNELS:
        raise InputError(f"{kernel!r} is no kernel", field="--kernel", valid=", ".join(_KERNELS))
    graph = _read(file)
    started = time.process_time()
    with Console(stderr=True).status("optimising"):
        done = optimise(graph, OptimiseConfig(kernel=cast(Kernel, kernel)))
    cpu_s = time.process_time() - started
    if out is not None:
        out.write_text(write_g2o(done.graph), encoding="utf-8")
    if picture is not None:
        from companion.report.pose_graph_picture import draw_pose_graph

        draw_pose_graph(graph, done.graph, done.refused, picture)
    facts = _facts(graph, done, cpu_s)
    if as_json:
        typer.echo(msgspec.json.encode(facts).decode())
        return
    console = Console(highlight=False)
    for name, value in facts.items():
        console.print(f"{name.replace('_', ' '):<14}{value:,.6g}" if isinstance(value, float) else f"{name:<14}{value}")
    for what in (out, picture):
        if what is not None:
            console.print(f"written       {what}")


def _read(file: Path) -> PoseGraph:
    try:
        text = file.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"cannot be read: {error}", file=str(file), valid="a g2o text file") from error
    return check(read_g2o(text, file=str(file)), file=str(file))


def _facts(graph: PoseGraph, done: Optimised, cpu_s: float) -> dict[str, float | int]:
    return {
        "poses": len(graph.ids),
        "odometry": int(graph.consecutive.sum()),
        "closures": int((~graph.consecutive).sum()),
        "refused": len(done.refused),
        "error_before": done.error_before,
        "error": done.error,
        "cpu_s": round(cpu_s, 3),
    }
