"""MCL against EKF in a warehouse: tracking, kidnapped, and a start among aisles that look alike."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import numpy as np

from companion.core.messages import Array
from companion.estimation.mcl.map_filter import MapFilter
from companion.estimation.mcl.particles import MclConfig, MonteCarlo
from companion.estimation.mcl.prior_map import FieldModel, PriorMap
from companion.runtime.bench import warehouse_plan as plan
from companion.runtime.bench.estimator_row import EstimatorRow

CASES = ("tracking", "kidnapped", "ambiguous aisles")
CELL_M, REACH_M = 0.1, 1.0
RIGHT_M = 0.5  # nearer than this is right
SURE_SHARE, SURE_SIGMA_M = 0.95, 0.5  # what makes MCL and EKF sure of their answer
GLOBAL_PARTICLES = 150_000
START_SIGMAS = np.array([0.3, 0.3, 1e-6, 0.1])
CONFIG = MclConfig(model=FieldModel(independent=8.0), turn_sigma_rad=0.015, most=GLOBAL_PARTICLES)


@dataclass(slots=True)
class Trace:
    """One run, step by step."""

    error_m: list[float] = field(default_factory=list)
    sure: list[bool] = field(default_factory=list)
    nees: list[float] = field(default_factory=list)
    particles: list[int] = field(default_factory=list)
    cpu_ms: list[float] = field(default_factory=list)
    truth: list[Array] = field(default_factory=list)
    pose: list[Array] = field(default_factory=list)
    carried: int = -1

    def note(self, truth: Array, pose: Array, covariance: Array, sure: bool, particles: int, cpu_s: float) -> None:
        """Append a step."""
        off = pose - truth
        off[3] = np.arctan2(np.sin(off[3]), np.cos(off[3]))
        kept = [0, 1, 3]
        spread = covariance[np.ix_(kept, kept)] + 1e-8 * np.eye(3)
        self.error_m.append(float(np.linalg.norm(off[:2])))
        self.nees.append(float(off[kept] @ np.linalg.solve(spread, off[kept])) / 3)
        self.sure.append(sure)
        self.particles.append(particles)
        self.cpu_ms.append(1e3 * cpu_s)
        self.truth.append(truth)
        self.pose.append(pose.copy())


def waypoints(case: str, rng: np.random.Generator) -> tuple[Array, tuple[int, int] | None]:
    """The way of a case (K, 2), and the leap of the kidnapped."""
    left, right, middle = plan.BLOCKS_X[0] - 2.0, plan.BLOCKS_X[1] + plan.RACK_M[0] + 0.8, 28.0
    order = rng.permutation(6)
    if case == "ambiguous aisles":
        k, other = order[:2]
        x = plan.BLOCKS_X[int(rng.integers(2))] + 10.0
        end = middle if x < middle else right
        here, there = plan.aisle_y(k), plan.aisle_y(other)
        way = [[x, here], [end, here], [end, there], [middle - 12.0, there], [left, there], [left, 20.0]]
        return np.array(way), None
    a, b, c, d = (plan.aisle_y(k) for k in order[:4])
    way = [[left, a], [middle, a], [middle, b], [right, b], [right, c], [middle, c], [left, c], [left, d], [middle, d]]
    return np.array(way), (4, 6) if case == "kidnapped" else None


def run_mcl(case: str, seed: int, prior: PriorMap, walls: Array) -> Trace:
    """One drive with MCL; `kidnapped` and `tracking` begin where the vehicle is, the third anywhere."""
    rng, world = np.random.default_rng([seed, 1]), np.random.default_rng([seed, 2])
    way, leap = waypoints(case, world)
    elsewhere = plan.free_poses(rng, GLOBAL_PARTICLES)
    mcl: MonteCarlo | None = None
    trace = Trace()
    for step in plan.drive(way, walls, world, leap=leap):
        before = time.process_time()
        if mcl is None:
            near = step.truth + rng.normal(0.0, 1.0, (2000, 4)) * START_SIGMAS
            mcl = MonteCarlo(elsewhere if case == "ambiguous aisles" else near, prior, CONFIG)
        mcl.move(rng, step.odometry, step.turn_rad)
        mcl.see(step.scan)
        found = mcl.estimate()
        mcl.resample(rng, elsewhere)
        _note(trace, step, found.pose, found.covariance, found.share > SURE_SHARE, len(mcl.poses), before)
    return trace


def run_ekf(case: str, seed: int, prior: PriorMap, walls: Array) -> Trace:
    """The same drive with the EKF; of aisles that look alike it is told another."""
    rng, world = np.random.default_rng([seed, 3]), np.random.default_rng([seed, 2])
    way, leap = waypoints(case, world)
    ekf: MapFilter | None = None
    trace = Trace()
    for step in plan.drive(way, walls, world, leap=leap):
        before = time.process_time()
        if ekf is None:
            told = step.truth + rng.normal(0.0, 1.0, 4) * START_SIGMAS
            if case == "ambiguous aisles":
                rows = np.array([plan.aisle_y(k) for k in range(6)])
                told[1] += rng.choice(rows[np.abs(rows - step.truth[1]) > 1.0]) - step.truth[1]
            ekf = MapFilter(told, np.diag(START_SIGMAS**2), prior, CONFIG)
        ekf.move(step.odometry, step.turn_rad)
        ekf.see(step.scan)
        sure = float(np.sqrt(np.trace(ekf.P[:2, :2]))) < SURE_SIGMA_M
        _note(trace, step, ekf.pose.copy(), ekf.P, sure, 1, before)
    return trace


def _note(
    trace: Trace, step: plan.Step, pose: Array, covariance: Array, sure: bool, particles: int, before: float
) -> None:
    trace.note(step.truth, pose, covariance, sure, particles, time.process_time() - before)
    if step.carried:
        trace.carried = len(trace.error_m) - 1


RUNS: dict[str, Callable[[str, int, PriorMap, Array], Trace]] = {"mcl": run_mcl, "ekf": run_ekf}


def warehouse_map() -> tuple[PriorMap, Array]:
    """The prior map, and the walls that the scanner sees."""
    walls = plan.segments()
    return PriorMap(plan.known_points(walls), cell_m=CELL_M, reach_m=REACH_M), walls


def bench_warehouse(seeds: int) -> Iterator[EstimatorRow]:
    """Both estimators on the same drives, `seeds` of each case."""
    prior, walls = warehouse_map()
    for case in CASES:
        for name, run in RUNS.items():
            traces = [run(case, seed, prior, walls) for seed in range(seeds)]
            yield EstimatorRow(study="warehouse", case=case, estimator=name, figures=figures(traces, case))


def figures(traces: list[Trace], case: str) -> dict[str, float | None]:
    """What the drives of one case came to."""
    ends = [t.error_m[-1] for t in traces]
    first = {"tracking": 10}.get(case, 0)
    counted = [(t, max(t.carried, 0) if case == "kidnapped" else first) for t in traces]
    found_s = [_found_s(t, begin) for t, begin in counted]
    wrong = [_sure_and_wrong(t, begin) for t, begin in counted]
    right = [e < RIGHT_M for e in ends]
    settled = [
        (t.error_m[k:], t.nees[k:])
        for (t, b), found, ok in zip(counted, found_s, right, strict=True)
        if ok and found is not None
        for k in [b + round(found / plan.STEP_S)]
    ]
    known = [s for s in found_s if s is not None]
    return {
        "drives": float(len(traces)),
        "right at the end": float(np.mean(right)),
        "found after, median s": float(np.median(known)) if known else None,
        "share of time sure and wrong": float(np.mean(wrong)),
        "error once found, rms m": _rms([e for es, _ in settled for e in es]),
        "NEES per dof once found": float(np.mean([n for _, ns in settled for n in ns])) if settled else None,
        "particles, median": float(np.median([n for t in traces for n in t.particles])),
        "CPU ms per scan": float(np.mean([c for t in traces for c in t.cpu_ms])),
    }


def _sure_and_wrong(trace: Trace, begin: int) -> float:
    """Share of the steps from `begin` on in which it was sure of a place more than a metre off."""
    steps = zip(trace.sure[begin:], trace.error_m[begin:], strict=True)
    return float(np.mean([sure and error > 2.0 * RIGHT_M for sure, error in steps]))


def _found_s(trace: Trace, begin: int) -> float | None:
    """Seconds until the estimate is right for good."""
    wrong = [k for k, e in enumerate(trace.error_m) if e >= RIGHT_M and k >= begin]
    last = wrong[-1] + 1 if wrong else begin
    return (last - begin) * plan.STEP_S if last < len(trace.error_m) else None


def _rms(values: list[float]) -> float | None:
    return float(np.sqrt(np.mean(np.square(values)))) if values else None
