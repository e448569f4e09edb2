"""`companion bench tracking`: how near the vehicle stays to its path, against the truth."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Annotated, TypeVar

import typer
from rich.console import Console
from rich.table import Table

from companion.cli.bench_rows import check_out, written
from companion.cli.bus_options import Json
from companion.cli.flight_input import stack_config
from companion.cli.simulation import Simulator, open_simulator
from companion.core.errors import InputError
from companion.mission.model import Mission, parse_mission
from companion.runtime.bench.tracking import ESTIMATES, METHODS, Estimate, TrackingRow, bench_tracking
from companion.runtime.bench.tracking_courses import forest_course, slalom
from companion.runtime.bench.tracking_pilot import Course
from companion.tracking.follow import Method

T = TypeVar("T", bound=str)
COURSES = ("forest", "sparse", "slalom")
WORLD = "poisson,size_m=170,stems_per_ha={},branches=4,slope_deg=0,roughness_m=0.02,start_m=45/85"
GUSTS = ("sim.wind.mean_m_s=2.0", "sim.wind.heading_deg=60", "sim.wind.gust_m_s=1.0")
_MISSION = "version: 1\nname: course\nsteps:\n  - {do: takeoff, alt: 3.0}\n  - {do: land}\n"  # the guards' fence: none
COLUMNS = (
    "course", "method", "limit m/s", "mean m/s", "top m/s", "rmse m", "target", "worst m", "estimate rmse m",
    "past end m", "clear m", "met",
)  # fmt: skip


def tracking(
    speeds: Annotated[str, typer.Option(help="Speed limits, m/s.")] = "2,4,6,8",
    methods: Annotated[
        list[str] | None, typer.Option("--method", help="This law; give it again for more. None: all.")
    ] = None,
    course: Annotated[
        str,
        typer.Option(help="forest: the planner's way through 200 stems/ha; sparse: through 50; slalom: in the open."),
    ] = "forest",
    estimate: Annotated[
        str, typer.Option(help="own: LiDAR and IMU in the loop; true: no estimator, 20 x faster.")
    ] = "own",
    seed: Annotated[int, typer.Option(min=0, help="Of forest, gusts and sensors.")] = 1,
    set_: Annotated[list[str] | None, typer.Option("--set", help="Override, sim.* too; repeatable.")] = None,
    out: Annotated[Path | None, typer.Option(help="Write the rows there, too, one JSON object per line.")] = None,
    as_json: Json = False,
) -> None:
    """Measure tracking errors in gusts, each law on the same paths. Example: companion bench tracking --speeds 4,8

    Full simulator in lockstep: rigid body, autopilot over MAVLink, and estimators if --estimate own, which takes about
    twenty minutes for all rows. JSON is also printed if standard output is no terminal.
    """
    check_out(out)
    laws = [one_of(m, METHODS, "--method") for m in methods or METHODS]
    source: Estimate = one_of(estimate, ESTIMATES, "--estimate")
    limits, console, done = speed_limits(speeds), Console(), []
    plain = as_json or not console.is_terminal
    flown = rows(course, limits, laws, source, seed=seed, overrides=set_ or [], console=Console(stderr=True))
    for row in written(flown, out=out, plain=plain):
        done.append(row)
        if not plain:
            console.print(f"{row.course}, {row.method}, {row.limit_m_s:g} m/s: done", highlight=False)
    if not plain:
        console.print(tracking_table(done))


def rows(
    course: str,
    limits: list[float],
    laws: list[Method],
    estimate: Estimate,
    *,
    seed: int,
    overrides: list[str],
    console: Console,
) -> Iterator[TrackingRow]:
    """The bench's rows in a simulator of their own."""
    config = stack_config(None, tuple(overrides))
    with course_simulator(course, estimate, seed=seed, overrides=overrides, console=console) as sim:
        courses = [maker(course, sim)(limit) for limit in limits]
        yield from bench_tracking(
            courses, laws, config, estimate=estimate, new_sim=sim.new_node, mission=course_mission()
        )


def course_simulator(
    course: str, estimate: Estimate, *, seed: int, overrides: list[str], console: Console
) -> AbstractContextManager[Simulator]:
    """The simulator with gusts; without rendering where the truth stands in for the estimators."""
    bare = one_of(course, COURSES, "--course") == "slalom" and estimate != "own"
    world = "empty" if bare else WORLD.format(50 if course == "sparse" else 200)
    blind = [] if estimate == "own" else ["sim.render=false"]
    own = [o for o in overrides if o.startswith("sim.")]
    return open_simulator(world, seed, [*GUSTS, *blind, *own], 0, console)


def maker(course: str, sim: Simulator) -> Callable[[float], Course]:
    """From a speed limit to a course."""
    if course == "slalom":
        return lambda limit: slalom(top_m_s=limit)
    return lambda limit: forest_course(sim.world.cones, top_m_s=limit, seed=sim.seed, name=course)


def course_mission() -> Mission:
    """A mission that nobody reads: `PilotNode` leads."""
    return parse_mission(_MISSION, file="course")


def speed_limits(text: str) -> list[float]:
    """Numbers from text such as 2,4,8; raises InputError."""
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        values = []
    if not values or not all(0.5 <= v <= 12.0 for v in values):
        raise InputError(f"{text!r}", field="--speeds", valid="numbers from 0.5 to 12, with commas")
    return values


def tracking_table(done: list[TrackingRow]) -> Table:
    """The rows as people read them."""
    own = all(row.estimate == "own" for row in done)
    table = Table(title=f"Across the path, against the truth; in gusts, {'own' if own else 'perfect'} estimate")
    for name in COLUMNS:
        table.add_column(name, justify="left" if name in ("course", "method") else "right")
    for row in done:
        table.add_row(*cells(row))
    return table


def cells(row: TrackingRow) -> list[str]:
    """One text per column."""
    s = row.score
    figures = (s.mean_m_s, s.top_m_s)
    met = (
        f"no: touched {s.contact}" if s.contact else "no: did not arrive" if not s.ended else "yes" if row.met else "no"
    )
    return [
        row.course, row.method, f"{row.limit_m_s:g}", *(f"{f:.2f}" for f in figures), f"{s.rmse_m:.3f}",
        f"{row.target_rmse_m:.2f}", f"{s.worst_m:.3f}", 
        f"{s.rmse_estimate_m:.3f}", f"{s.past_end_m:.3f}", f"{s.clearance_m:.2f}", met,
    ]  # fmt: skip


def one_of(value: str, valid: tuple[T, ...], option: str) -> T:
    """The choice that `value` names; raises InputError."""
    for choice in valid:
        if choice == value:
            return choice
    raise InputError(f"{value!r}", field=option, valid=", ".join(map(str, valid)))
