"""`companion bench estimators`: filters, graph and Monte Carlo localisation on the same data."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import chain
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.table import Table

from companion.cli.bench_rows import check_out, written
from companion.cli.bus_options import Json
from companion.cli.flight_input import stack_config
from companion.core.errors import InputError
from companion.estimation.filters.interface import ESTIMATORS
from companion.runtime.bench import estimators_real as real
from companion.runtime.bench.estimator_row import EstimatorRow
from companion.runtime.bench.estimators_flights import bench_flight
from companion.runtime.bench.estimators_warehouse import bench_warehouse
from companion.runtime.inertial_recordings import flow_flight, kitti_drive, rtk_flights

STUDIES = ("warehouse", "kitti", "rtk", "flow", "flights")
_RTK, _FLOW = "imu_rtk_quadrotor_ansfl", "flow_imu_quad_inertialnav/quadOptFlowLogData.zip"


def estimators(
    study: Annotated[
        list[str] | None, typer.Option("--study", help="This one; give it again for more. None: all there is data for.")
    ] = None,
    data: Annotated[Path | None, typer.Option(help=f"Folder that holds {_RTK}/ and {_FLOW}.")] = None,
    estimator: Annotated[
        list[str] | None, typer.Option("--estimator", help="Of real recordings: ekf, ukf, graph; repeatable.")
    ] = None,
    flight: Annotated[
        list[Path] | None, typer.Option(help="Folder of companion fly --record, for the study flights; repeatable.")
    ] = None,
    for_s: Annotated[float, typer.Option("--for-s", min=5, help="Seconds of each flight.")] = 60.0,
    seeds: Annotated[int, typer.Option(min=1, max=200, help="Drives of each case of the warehouse.")] = 10,
    out: Annotated[Path | None, typer.Option(help="Write the rows there, too, one JSON object per line.")] = None,
    as_json: Json = False,
) -> None:
    """Compare estimators on the same data. Example: companion bench estimators --study warehouse --seeds 20

    warehouse: MCL against EKF in a simulated plan. kitti: gtsam's drive. rtk, flow: real flights, with --data.
    --flight alone: that simulated flight through EKF, UKF, graph and MCL.
    JSON is also printed if standard output is no terminal.
    """
    check_out(out)
    names = _valid(estimator or list(ESTIMATORS), ESTIMATORS, "--estimator")
    wanted = _valid(study or [s for s in STUDIES if data or s not in ("rtk", "flow", "flights")], STUDIES, "--study")
    console = Console()
    plain = as_json or not console.is_terminal
    flights = bench_flights(flight or [], for_s) if flight or "flights" in wanted else iter(())
    for row in written(chain(_rows([] if flight else wanted, names, data, seeds), flights), out=out, plain=plain):
        if not plain:
            console.print(table(row))


def _rows(wanted: list[str], names: list[str], data: Path | None, seeds: int) -> Iterator[EstimatorRow]:
    if "warehouse" in wanted:
        yield from bench_warehouse(seeds)
    if "kitti" in wanted:
        yield from real.bench_fixes(real.KITTI, [kitti_drive(gtsam_data())], names)
    if "rtk" in wanted:
        yield from real.bench_fixes(real.RTK, real.rtk_recordings(rtk_flights(_folder(data) / _RTK)), names)
    if "flow" in wanted:
        yield from real.bench_flow(flow_flight(_folder(data) / _FLOW), names)


def bench_flights(folders: list[Path], for_s: float) -> Iterator[EstimatorRow]:
    """Every front end on each flight; raises InputError if there is none."""
    if not folders:
        raise InputError("needs a flight", field="--flight", valid="a folder of companion fly --record")
    for folder in folders:
        yield from bench_flight(folder, stack_config(None, ()), for_s=for_s)


def gtsam_data() -> Path:
    """The folder of example data in gtsam's wheel."""
    import gtsam

    return Path(gtsam.__file__).parent / "Data"


def table(row: EstimatorRow) -> Table:
    """One row as people read it."""
    shown = Table(title=f"{row.study}, {row.case}: {row.estimator}", title_justify="left", show_header=False)
    for name, value in row.figures.items():
        shown.add_row(name, "-" if value is None else f"{value:.3g}")
    return shown


def _folder(data: Path | None) -> Path:
    if data is None:
        raise InputError("needs recordings", field="--data", valid=f"the folder that holds {_RTK}/ and {_FLOW}")
    return data


def _valid(given: list[str], valid: tuple[str, ...], option: str) -> list[str]:
    for one in given:
        if one not in valid:
            raise InputError(f"{one!r}", field=option, valid=", ".join(valid))
    return given
