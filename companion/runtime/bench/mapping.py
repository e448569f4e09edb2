"""The map beside its peers, row by row: `companion bench mapping`.

for row in bench_mapping(["insert_os64_0.2"], Options()):
    print(row.ratio, row.met)
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path

import msgspec

from companion.core.errors import InputError
from companion.runtime.bench.mapping_correction import correction_figures
from companion.runtime.bench.mapping_cycle import time_cycle
from companion.runtime.bench.mapping_field import FieldPeer, time_field
from companion.runtime.bench.mapping_forest import DENSE, FLIGHT_SCANS, OPEN, Lidar, fly, make_forest
from companion.runtime.bench.mapping_insert import agreement, time_insertion, time_threads
from companion.runtime.bench.mapping_memory import memory_figures
from companion.runtime.bench.mapping_peers import Prototype, RayPer
from companion.runtime.bench.mapping_scans import PAIR, VELODYNE, Scan, pair_scans, velodyne_scans
from companion.runtime.bench.mapping_thin import Thin, thin_recall

_TIMED_FROM = 60  # number of the first timed scan: well inside the forest
_TIMED = 4  # scans of which the first is set apart


class Options(msgspec.Struct, frozen=True, kw_only=True):
    """How thoroughly to measure."""

    scans: int = FLIGHT_SCANS  # of the agreement with OctoMap
    rounds: int = 5  # of each of both, in turns, of which the smallest times count
    data: Path = Path("data")  # folder with the real scans
    prototype: Path | None = None  # Python file of another map (`mapping_peers.Prototype`), for insertion of points


class MappingRow(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """One measurement. `figures[gauge]` is what `target` and `aim` are about."""

    name: str
    peer: str = ""
    ours_ms: float | None = None  # CPU
    peer_ms: float | None = None
    ratio: float | None = None  # peer_ms / ours_ms
    gauge: str = "ratio"
    target: float | None = None
    aim: float | None = None
    met: bool | None = None  # the target
    aim_met: bool | None = None
    figures: dict[str, float] = {}
    rounds: int = 0  # of each of both; 0: nothing was timed
    skipped: str = ""  # why there is no measurement
    machine_load: float = 0.0  # runnable processes in the minute before, of `cores`
    cores: int = 0


class _Goal(msgspec.Struct, frozen=True):
    gauge: str
    target: float
    aim: float | None = None
    at_most: bool = False  # smaller is better


Measurement = Callable[[Options], tuple[str, dict[str, float]]]  # peer, figures


def bench_mapping(names: Sequence[str], options: Options) -> Iterator[MappingRow]:
    """One row after another, all if `names` is empty; raises CompanionError if a peer is missing."""
    for name in names:
        if name not in ROWS:
            raise InputError(f"no row {name!r}", field="--rows", valid=", ".join(ROWS))
    for name in names or ROWS:
        measure, goal = ROWS[name]
        load = round(os.getloadavg()[0], 2)
        try:
            peer, figures = measure(options)
        except FileNotFoundError as error:
            yield MappingRow(name=name, skipped=f"no {error.filename}: see --data")
            continue
        yield _row(name, peer, figures, goal, load)


def _row(name: str, peer: str, figures: dict[str, float], goal: _Goal | None, load: float) -> MappingRow:
    ours_ms, peer_ms = figures.pop("ours_ms", None), figures.pop("peer_ms", None)
    rounds = int(figures.pop("rounds", 0))
    ratio = peer_ms / ours_ms if ours_ms and peer_ms else None
    gauged = figures | ({} if ratio is None else {"ratio": ratio})
    row = MappingRow(
        name=name,
        peer=peer,
        ours_ms=_rounded(ours_ms),
        peer_ms=_rounded(peer_ms),
        ratio=_rounded(ratio),
        figures={key: _rounded(value) or 0.0 for key, value in figures.items()},
        rounds=rounds,
        machine_load=load,
        cores=os.cpu_count() or 1,
    )
    if goal is None:
        return row
    value = gauged[goal.gauge]
    reached = [None if g is None else (value <= g if goal.at_most else value >= g) for g in (goal.target, goal.aim)]
    return msgspec.structs.replace(
        row, gauge=goal.gauge, target=goal.target, aim=goal.aim, met=reached[0], aim_met=reached[1]
    )


def _rounded(value: float | None) -> float | None:
    return None if value is None else float(f"{value:.7g}")


def _forest_scans(lidar: Lidar, numbers: range) -> Iterator[Scan]:
    forest = make_forest(OPEN, seed=2) if lidar == "os64" else make_forest(DENSE, seed=1)
    return fly(forest, lidar, numbers=numbers)


def _insert_forest(
    lidar: Lidar, resolution_m: float, options: Options, *, ray_per: RayPer = "point"
) -> tuple[str, dict[str, float]]:
    return "OctoMap", _insertion(_few_scans(lidar), resolution_m, options, ray_per)


def _insertion(scans: list[Scan], resolution_m: float, options: Options, ray_per: RayPer) -> dict[str, float]:
    prototype = Prototype(options.prototype) if options.prototype and ray_per == "point" else None
    return time_insertion(scans, resolution_m, rounds=options.rounds, ray_per=ray_per, prototype=prototype)


def _few_scans(lidar: Lidar) -> list[Scan]:
    return list(_forest_scans(lidar, range(_TIMED_FROM, _TIMED_FROM + _TIMED)))


def _threads(lidar: Lidar, resolution_m: float, options: Options) -> tuple[str, dict[str, float]]:
    return "", time_threads(_few_scans(lidar), resolution_m, rounds=options.rounds)


def _insert_real(
    kind: str, resolution_m: float, options: Options, *, ray_per: RayPer = "point"
) -> tuple[str, dict[str, float]]:
    folder = options.data / kind
    if not folder.is_dir():
        raise FileNotFoundError(2, "no such folder", str(folder))
    scans = list(velodyne_scans(folder, count=_TIMED) if kind == VELODYNE else pair_scans(folder))
    return "OctoMap", _insertion(scans, resolution_m, options, ray_per)


def _agree(
    lidar: Lidar, resolution_m: float, options: Options, *, ray_per: RayPer = "point"
) -> tuple[str, dict[str, float]]:
    return "OctoMap", agreement(_forest_scans(lidar, range(options.scans)), resolution_m, ray_per=ray_per)


def _field(peer_name: FieldPeer, options: Options) -> tuple[str, dict[str, float]]:
    scans = list(_forest_scans("os64", range(_TIMED_FROM, _TIMED_FROM + 20, 5)))
    return peer_name, time_field(scans, peer_name, rounds=options.rounds)


def _cycle(options: Options) -> tuple[str, dict[str, float]]:
    return "OctoMap's insertion alone", time_cycle(_few_scans("os64"), rounds=options.rounds)


def _correction(_: Options) -> tuple[str, dict[str, float]]:
    return "", correction_figures()


def _memory(_: Options) -> tuple[str, dict[str, float]]:
    return "", memory_figures()


def _thin(kind: Thin, lidar: Lidar, resolution_m: float, _: Options) -> tuple[str, dict[str, float]]:
    return "OctoMap", thin_recall(kind, lidar, resolution_m)


_FOREST, _REAL = _Goal("ratio", 180, 300), _Goal("ratio", 35, 60)
_AGREE, _THIN = _Goal("agreement", 0.9999), _Goal("flown_recall", 0.95)
ROWS: dict[str, tuple[Measurement, _Goal | None]] = {
    "insert_os64_0.2": (partial(_insert_forest, "os64", 0.2), _FOREST),
    "insert_os64_0.1": (partial(_insert_forest, "os64", 0.1), _FOREST),
    "insert_mid360_0.2": (partial(_insert_forest, "mid360", 0.2), _FOREST),
    "insert_mid360_0.1": (partial(_insert_forest, "mid360", 0.1), _FOREST),
    "insert_hdl64_0.2": (partial(_insert_real, VELODYNE, 0.2), _REAL),
    "insert_hdl64_0.1": (partial(_insert_real, VELODYNE, 0.1), _REAL),
    "insert_pair_0.2": (partial(_insert_real, PAIR, 0.2), _REAL),
    "insert_pair_0.1": (partial(_insert_real, PAIR, 0.1), _REAL),
    "insert_os64_0.2_end_voxel": (partial(_insert_forest, "os64", 0.2, ray_per="end_voxel"), None),
    "insert_pair_0.2_end_voxel": (partial(_insert_real, PAIR, 0.2, ray_per="end_voxel"), None),
    "threads_os64_0.2": (partial(_threads, "os64", 0.2), _Goal("same_map", 1)),
    "threads_os64_0.1": (partial(_threads, "os64", 0.1), _Goal("same_map", 1)),
    "agree_os64_0.2": (partial(_agree, "os64", 0.2), _AGREE),
    "agree_mid360_0.2": (partial(_agree, "mid360", 0.2), _AGREE),
    "agree_mid360_0.2_end_voxel": (partial(_agree, "mid360", 0.2, ray_per="end_voxel"), _AGREE),
    "field_edt": (partial(_field, "edt"), _Goal("ratio", 14, 25)),
    "field_scipy": (partial(_field, "scipy"), _Goal("ratio", 32, 55)),
    "cycle": (_cycle, None),
    "thin_trunks": (partial(_thin, "trunks", "os64", 0.2), _THIN),
    "thin_trunks_mid360": (partial(_thin, "trunks", "mid360", 0.2), _THIN),
    "thin_branches": (partial(_thin, "branches", "os64", 0.2), _THIN),
    "thin_branches_mid360": (partial(_thin, "branches", "mid360", 0.2), _THIN),
    "thin_branches_0.1": (partial(_thin, "branches", "os64", 0.1), _THIN),
    "correction": (_correction, _Goal("correction_s", 2, at_most=True)),
    "memory": (_memory, _Goal("rss_growth_mb", 200, at_most=True)),
}
