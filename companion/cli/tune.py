"""`companion tune`: find settings by flying with them."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import msgspec
import typer
from rich.console import Console
from rich.table import Table

from companion.cli.bench_tracking import course_mission, course_simulator, one_of
from companion.cli.bus_options import Json, say
from companion.cli.flight_input import stack_config
from companion.core.errors import InputError
from companion.report.lookahead_picture import draw_lookahead
from companion.runtime.bench.tracking_courses import slalom
from companion.runtime.bench.tracking_lookahead import (
    AHEADS,
    KEYS,
    VALUES,
    LookaheadRow,
    best_of,
    course_of_file,
    course_of_flight,
    sweep,
)
from companion.runtime.bench.tracking_pilot import Course

_COLUMNS = ("ahead s", "m", "rmse m", "worst m", "jerk m/s3", "late s", "sides per m", "past end m")


def lookahead(
    flight: Annotated[Path | None, typer.Option(help="Folder of a recorded flight: its way again.")] = None,
    path: Annotated[Path | None, typer.Option(help="CSV of x,y,z, m. Neither: a slalom.")] = None,
    method: Annotated[str, typer.Option(help="preview or pure_pursuit.")] = "preview",
    speed: Annotated[float, typer.Option(min=0.5, max=12, help="Speed limit, m/s.")] = 6.0,
    values: Annotated[str, typer.Option(help="Lookahead times, s, such as 0.1,0.2,0.3. Empty: about ten.")] = "",
    seed: Annotated[int, typer.Option(min=0, help="Of gusts and sensors.")] = 1,
    set_: Annotated[list[str] | None, typer.Option("--set", help="Override, sim.* too; repeatable.")] = None,
    out: Annotated[Path, typer.Option(help="Folder for lookahead.png and lookahead.json.")] = Path("."),
    as_json: Json = False,
) -> None:
    """Sweep the lookahead and name the best. Example: companion tune lookahead --method pure_pursuit --speed 4

    Flies the way once per value in the simulator, in gusts, with a perfect estimate: about half a minute.
    """
    law = one_of(method, AHEADS, "--method")
    times = _times(values) or VALUES[law]
    if not out.is_dir():
        raise InputError("no such folder", field="--out", file=str(out))
    course, console = _course(flight, path, speed), Console(stderr=True)
    config = stack_config(None, tuple(set_ or ()))
    with course_simulator("slalom", "true", seed=seed, overrides=set_ or [], console=console) as sim:
        rows = list(sweep(course, law, times, config, new_sim=sim.new_node, mission=course_mission()))
    best = best_of(rows)
    draw_lookahead(rows, best, out / "lookahead.png")
    answer = msgspec.json.format(msgspec.json.encode({"best": best, "rows": rows}), indent=1)
    (out / "lookahead.json").write_bytes(answer)
    if as_json:
        say(answer.decode())
        return
    Console().print(lookahead_table(rows, best))
    Console().print(f"best: {best.lookahead_s:g} s; to fly it: --set {KEYS[law]}={best.lookahead_s:g}", highlight=False)


def lookahead_table(rows: list[LookaheadRow], best: LookaheadRow) -> Table:
    """The sweep as people read it."""
    table = Table(title=f"{best.method} on {best.course}, gusts, perfect estimate")
    for name in _COLUMNS:
        table.add_column(name, justify="right")
    for row in rows:
        s = row.score
        figures = (row.lookahead_m, s.rmse_m, s.worst_m, s.jerk_m_s3, s.late_s, s.wobble_per_m, s.past_end_m)
        words = [f"{row.lookahead_s:g}", *(f"{f:.3f}" for f in figures)]
        table.add_row(*words, style="bold" if row is best else None)
    return table


def _course(flight: Path | None, path: Path | None, speed: float) -> Course:
    if flight is not None and path is not None:
        raise InputError("give one of them", field="--flight, --path")
    if flight is not None:
        return course_of_flight(flight, top_m_s=speed)
    return slalom(top_m_s=speed) if path is None else course_of_file(path, top_m_s=speed)


def _times(text: str) -> tuple[float, ...]:
    try:
        values = tuple(float(part) for part in text.split(",") if part.strip())
    except ValueError:
        values = (-1.0,)
    if not all(0.0 <= v <= 5.0 for v in values):
        raise InputError(f"{text!r}", field="--values", valid="numbers from 0 to 5, with commas")
    return values
