"""Every planner on the same worlds: how often it arrives, how long its ways are, what they cost.

for row in bench_planners(["maze_2d"], list(PLANNERS), runs=5):
    print(row.planner, row.cost_ratio, row.cpu_ms)
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import msgspec
import numpy as np

from companion.planning.lattice.planner import LatticeConfig
from companion.planning.planner import Plan, Planner
from companion.planning.registry import PlannerSettings, make_planner
from companion.planning.roadmap import PRM
from companion.runtime.bench.planners_worlds import World, make_world

_LATTICE = ("dijkstra", "astar", "theta_star")
_SAMPLES = {"rrt": 100_000, "rrt_connect": 40_000, "rrt_star": 10_000, "prm": 3000, "prm_star": 3000}
_OTHER_SAMPLES = 10_000  # of a planner that this file does not know
_SHORT_MS, _REPEATS = 50.0, 3  # a plan shorter than this is timed so many times


class PlannerRow(msgspec.Struct, frozen=True, kw_only=True):
    """Figures of one planner in one world, over all pairs of ends and, if it draws samples, all seeds."""

    world: str
    planner: str
    runs: int
    success: float
    """Share of runs that found a way."""
    cost_ratio: float | None
    """Median length over that of the shortest way known; none: no run found a way."""
    cost_ratio_worst: float | None
    cpu_ms: float
    """Median over runs, the least of repeated ones."""
    work: float
    """Median: samples, or expanded cells."""
    unit: str
    again_ms: float | None
    """Roadmaps: another query on the one that is there."""


@dataclass(frozen=True, slots=True)
class Run:
    """One plan and its CPU time."""

    plan: Plan
    cpu_ms: float
    again_ms: float


def bench_planners(
    worlds: Sequence[str], planners: Sequence[str], *, runs: int, say: Callable[[str], None] = lambda _: None
) -> Iterator[PlannerRow]:
    """Rows world by world; each world's come when all its planners are done, for the ratios need the shortest way."""
    for name in worlds:
        world = make_world(name)
        best = [shortest_known(world, k) for k in range(len(world.ends))]
        done: dict[str, list[tuple[int, Run]]] = {}
        for planner in planners:
            say(f"{name}: {planner}")
            done[planner] = [(k, run) for k in range(len(world.ends)) for run in run_pair(planner, world, k, runs=runs)]
            for k, run in done[planner]:
                best[k] = min(best[k], run.plan.cost_m)
        for planner in planners:
            yield _row(world, planner, done[planner], best)


def run_pair(planner: str, world: World, pair: int, *, runs: int) -> list[Run]:
    """Plans for one pair of ends: one if the planner draws no samples."""
    machine = planner_for(planner, world)
    _timed(machine, planner, world, pair, seed=0)  # compiles what is not compiled
    return [_timed(machine, planner, world, pair, seed=seed) for seed in range(1 if planner in _LATTICE else runs)]


def planner_for(name: str, world: World) -> Planner:
    """As configured, but in a plane world with the 8 neighbours of a plane."""
    lattice = LatticeConfig(neighbours=8) if world.plane else LatticeConfig()
    return make_planner(name, PlannerSettings(lattice=lattice))


def plan_once(machine: Planner, name: str, world: World, pair: int, *, seed: int) -> Plan:
    """One plan with the budget that the planner has here."""
    start, goal = world.ends[pair]
    budget = _SAMPLES.get(name, _OTHER_SAMPLES)
    return machine.plan(start, goal, world.space, rng=np.random.default_rng([seed, pair]), iterations=budget)


def _timed(machine: Planner, name: str, world: World, pair: int, *, seed: int) -> Run:
    plan, least = _clocked(lambda: plan_once(machine, name, world, pair, seed=seed))
    for _ in range(_REPEATS - 1 if least < _SHORT_MS else 0):
        least = min(least, _clocked(lambda: plan_once(machine, name, world, pair, seed=seed))[1])
    again = math.nan
    if isinstance(machine, PRM) and machine.roadmap is not None:
        roadmap, (start, goal) = machine.roadmap, world.ends[pair]
        again = min(_clocked(lambda: roadmap.query(start, goal, world.space))[1] for _ in range(_REPEATS))
    return Run(plan, least, again)


def _clocked(work: Callable[[], Plan]) -> tuple[Plan, float]:
    started = time.process_time_ns()
    plan = work()
    return plan, (time.process_time_ns() - started) * 1e-6


def shortest_known(world: World, pair: int) -> float:
    """Length of Theta*'s way after RRT* has bettered it, m."""
    (start, goal), space = world.ends[pair], world.space
    first = planner_for("theta_star", world).plan(start, goal, space, rng=np.random.default_rng(0), iterations=0)
    better = planner_for("rrt_star", world)
    rng, known = np.random.default_rng(1), first.path[1:-1]
    return min(first.cost_m, better.plan(start, goal, space, rng=rng, iterations=20_000, known_path=known).cost_m)


def _row(world: World, planner: str, done: list[tuple[int, Run]], best: list[float]) -> PlannerRow:
    ratios = [run.plan.cost_m / best[k] for k, run in done if run.plan.solved]
    again = [run.again_ms for _, run in done if not math.isnan(run.again_ms)]
    return PlannerRow(
        world=world.name,
        planner=planner,
        runs=len(done),
        success=round(len(ratios) / len(done), 4),
        cost_ratio=round(float(np.median(ratios)), 4) if ratios else None,
        cost_ratio_worst=round(max(ratios), 4) if ratios else None,
        cpu_ms=round(float(np.median([run.cpu_ms for _, run in done])), 3),
        work=float(np.median([run.plan.iterations for _, run in done])),
        unit="cells" if planner in _LATTICE else "samples",
        again_ms=round(float(np.median(again)), 3) if again else None,
    )
