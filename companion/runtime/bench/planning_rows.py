"""What the runs of `companion bench planning` say: one row per gauge, with its target."""

from __future__ import annotations

import math
import os

import msgspec
import numpy as np
from numpy.typing import NDArray

from companion.runtime.bench.planning_ompl import PEERS, Trace
from companion.runtime.bench.planning_worlds import FORESTS

Traces = dict[str, list[tuple[int, Trace]]]  # by planner: pair of ends and trace of each run
_NEAR = 1.02  # of the shortest way known
_CHECKS_MS = (5.0, 20.0, 50.0, 100.0, 500.0)
_HARD_RATIOS = {20: 1.01, 50: 1.005, 100: 1.002}  # ms: target
_FASTER = 25.0  # than OMPL's best, in hard worlds


class PlanningRow(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """One gauge in one world. Times are CPU milliseconds, ratios those to the shortest way known."""

    world: str
    gauge: str
    planner: str = "portfolio"
    value: float | None = None  # none: never
    target: float | None = None
    met: bool | None = None
    figures: dict[str, float | None] = {}
    note: str = ""
    machine_load: float = 0.0  # runnable processes in the minute before, of `cores`
    cores: int = 0


def world_rows(world: str, traces: Traces, best: list[float], *, skipped: str = "") -> list[PlanningRow]:
    """All rows of a world; without OMPL those that need it say why they are not there."""
    rows = _forest_rows(world, traces, best) if world in FORESTS else _hard_rows(world, traces, best)
    if skipped:
        return [*rows, _row(world, "OMPL", note=skipped)]
    rows.append(_time_row(world, traces, best))
    rows += [_rrt_star_row(world, peer, traces, best) for peer in ("RRTstar", "InformedRRTstar")]
    return [*rows, *(_planner_row(world, name, traces, best) for name in traces)]


def enclosed_row(proof: str, worst_ms: float, median_ms: float) -> PlanningRow:
    """The proof that there is no way."""
    met = proof == "infeasible" and worst_ms < 1000.0
    return _row("enclosed", "proof_ms", value=worst_ms, target=1000.0, met=met, figures={"median": median_ms})


def _forest_rows(world: str, traces: Traces, best: list[float]) -> list[PlanningRow]:
    runs = traces["portfolio"]
    first = 1e3 * np.array([trace[0][0] if trace else math.inf for _, trace in runs])
    return [
        _below(world, "first_p50_ms", float(np.median(first)), 0.3, aim=0.2),
        _below(world, "first_p95_ms", float(np.quantile(first, 0.95, method="higher")), 0.65, aim=0.5),
        _ratio_row(world, 5.0, 1.001, runs, best),
        _success_row(world, 50.0, runs),
    ]


def _hard_rows(world: str, traces: Traces, best: list[float]) -> list[PlanningRow]:
    runs = traces["portfolio"]
    ratios = [_ratio_row(world, ms, target, runs, best) for ms, target in _HARD_RATIOS.items()]
    return [_success_row(world, 50.0, runs), *ratios]


def _success_row(world: str, ms: float, runs: list[tuple[int, Trace]]) -> PlanningRow:
    share = float(np.mean([bool(trace) and 1e3 * trace[0][0] <= ms for _, trace in runs]))
    figures = {"runs": float(len(runs)), "at_the_end": float(np.mean([bool(trace) for _, trace in runs]))}
    return _row(world, f"success_{ms:g}ms", value=share, target=1.0, met=share >= 1.0, figures=figures)


def _ratio_row(world: str, ms: float, target: float, runs: list[tuple[int, Trace]], best: list[float]) -> PlanningRow:
    """Median over the runs."""
    ratios = _ratios_at(ms, runs, best)
    figures = {"p90": float(np.quantile(ratios, 0.9, method="higher")), "mean": float(np.mean(ratios))}
    return _below(world, f"cost_ratio_{ms:g}ms", float(np.median(ratios)), target, figures=figures)


def _time_row(world: str, traces: Traces, best: list[float]) -> PlanningRow:
    """How much sooner than OMPL's best planner the way is within 2 % of the shortest, median over the runs."""
    times = {name: _near_ms(runs, best) for name, runs in _same_runs(traces).items()}
    medians = {name: float(np.median(ms)) for name, ms in times.items()}
    rival = min(PEERS, key=lambda name: (medians[name], float(np.median(_ratios_at(500.0, traces[name], best)))))
    target = 1.0 if world in FORESTS else _FASTER
    ours, theirs = medians["portfolio"], medians[rival]
    figures = {f"{name}_ms": ms for name, ms in medians.items()}
    figures["rival_ratio_500ms"] = float(np.median(_ratios_at(500.0, traces[rival], best)))
    value = theirs / ours if math.isfinite(theirs) else math.inf
    met = math.isfinite(ours) and value >= target
    note = f"OMPL's best: {rival}" + ("" if math.isfinite(theirs) else ", never within 500 ms")
    return _row(world, "times_sooner_at_1.02", value=value, target=target, met=met, figures=figures, note=note)


def _rrt_star_row(world: str, peer: str, traces: Traces, best: list[float]) -> PlanningRow:
    """Is our RRT* alone no longer than OMPL's at equal CPU time? Median ratios, worst of the checkpoints."""
    figures: dict[str, float | None] = {}
    worst, same = -math.inf, _same_runs(traces)
    for ms in _CHECKS_MS:
        ours, theirs = (float(np.median(_ratios_at(ms, same[n], best))) for n in ("rrt_star", peer))
        figures[f"ours_{ms:g}ms"], figures[f"peer_{ms:g}ms"] = ours, theirs
        if math.isfinite(theirs):
            worst = max(worst, ours - theirs)
    value = worst if worst > -math.inf else math.inf
    met = worst <= 0.0
    note = "" if worst > -math.inf else f"{peer} never arrives in half of the runs"
    return _row(
        world, f"ratio_less_{peer}", planner="rrt_star", value=value, target=0.0, met=met, figures=figures, note=note
    )


def _same_runs(traces: Traces) -> Traces:
    """The runs, with the same ends, that all planners have."""
    count = min(len(runs) for runs in traces.values())
    return {name: runs[:count] for name, runs in traces.items()}


def _planner_row(world: str, name: str, traces: Traces, best: list[float]) -> PlanningRow:
    """For the table: no target."""
    runs, figures = traces[name], dict[str, float | None]()
    first = 1e3 * np.array([trace[0][0] if trace else math.inf for _, trace in runs])
    figures["first_p50_ms"] = float(np.median(first))
    for ms in _CHECKS_MS:
        figures[f"ratio_{ms:g}ms"] = float(np.median(_ratios_at(ms, runs, best)))
    near = _near_ms(runs, best)
    figures["near_share"] = float(np.mean(np.isfinite(near)))
    figures["runs"] = float(len(runs))
    return _row(world, "near_p50_ms", planner=name, value=float(np.median(near)), figures=figures)


def _ratios_at(ms: float, runs: list[tuple[int, Trace]], best: list[float]) -> NDArray[np.float64]:
    """Length over the shortest known after so much time, (R,); infinite: no way yet."""
    slack = 1.0 + 1e-3 if ms < 500.0 else 1.25  # the last slice of OMPL may end a little late
    found = [[length for t, length in trace if 1e3 * t <= ms * slack] for _, trace in runs]
    return np.array(
        [(lengths[-1] if lengths else math.inf) / best[k] for (k, _), lengths in zip(runs, found, strict=True)]
    )


def _near_ms(runs: list[tuple[int, Trace]], best: list[float]) -> NDArray[np.float64]:
    """When the way is within 2 % of the shortest, (R,); infinite: never."""
    return np.array(
        [next((1e3 * t for t, length in trace if length <= _NEAR * best[k]), math.inf) for k, trace in runs]
    )


def _below(
    world: str,
    gauge: str,
    value: float,
    target: float,
    *,
    aim: float | None = None,
    figures: dict[str, float] | None = None,
) -> PlanningRow:
    more: dict[str, float | None] = dict(figures or {})
    if aim is not None:
        more["aim"] = aim
    return _row(world, gauge, value=value, target=target, met=value <= target, figures=more)


def _row(world: str, gauge: str, **more: object) -> PlanningRow:
    """Rounded; what is infinite is none, for JSON knows no infinity."""
    figures = {name: _rounded(x) for name, x in dict(more.pop("figures", {})).items()}  # type: ignore[call-overload]
    value = _rounded(more.pop("value", None))  # type: ignore[arg-type]
    load, cores = round(os.getloadavg()[0], 2), os.cpu_count() or 0
    return PlanningRow(world=world, gauge=gauge, value=value, figures=figures, machine_load=load, cores=cores, **more)  # type: ignore[arg-type]


def _rounded(x: float | None) -> float | None:
    return None if x is None or not math.isfinite(x) else float(f"{x:.5g}")
