"""Our planners beside OMPL's in forests, hard worlds and real maps: `companion bench planning`.

for row in bench_planning(["forest_25"], PlanningOptions(runs=5)):
    print(row.world, row.gauge, row.value, row.target, row.met)
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import msgspec
import numpy as np

from companion.planning.planner import Query
from companion.planning.portfolio import Portfolio, PortfolioConfig
from companion.planning.rrt_star import RRTStar, RRTStarConfig
from companion.runtime.bench.planners_worlds import World
from companion.runtime.bench.planning_ompl import PEERS, Trace, missing, run_peer
from companion.runtime.bench.planning_rows import PlanningRow, Traces, enclosed_row, world_rows
from companion.runtime.bench.planning_worlds import PAIRS, enclosed_goal, planning_world

ENCLOSED = "enclosed"
_MOST_SAMPLES = 200_000  # the clock ends a run long before
_WARM_S = 0.02  # of a run before each that is measured: forking OMPL's children leaves pages that are slow to write
_LONG_S, _LONG_RUNS = 1.5, 1  # of the reference


class PlanningOptions(msgspec.Struct, frozen=True, kw_only=True):
    """How thoroughly to measure."""

    runs: int = 25  # per world and planner, over PAIRS of ends
    peer_runs: int = 10  # of OMPL's planners, the first of these runs
    budget_s: float = 0.5  # CPU time of a run
    data: Path = Path("data")  # folder with the real maps


def bench_planning(
    worlds: Sequence[str], options: PlanningOptions, *, say: Callable[[str], None] = lambda _: None
) -> Iterator[PlanningRow]:
    """Rows world by world; `enclosed` is the goal without a way. Our planners and OMPL's take turns, run by run."""
    portfolio, rrt_star = Portfolio(PortfolioConfig(), RRTStarConfig()), RRTStar(RRTStarConfig())
    for name in worlds:
        say(name)
        if name == ENCLOSED:
            yield _enclosed(portfolio)
            continue
        world = planning_world(name, data=options.data)
        for machine in (portfolio, rrt_star):
            run_ours(machine, world, 0, seed=1_000_000, budget_s=0.05)  # compiles what is not compiled
        traces: Traces = {}
        peers = () if missing() else PEERS
        for run in range(options.runs):
            pair, seed = run % PAIRS, run // PAIRS
            for ours, machine in (("portfolio", portfolio), ("rrt_star", rrt_star)):
                run_ours(machine, world, pair, seed=1_000_000 + seed, budget_s=_WARM_S)
                trace = run_ours(machine, world, pair, seed=seed, budget_s=options.budget_s)
                traces.setdefault(ours, []).append((pair, trace))
            for peer in peers if run < options.peer_runs else ():
                trace = run_peer(peer, world.space, *world.ends[pair], seed=run, budget_s=options.budget_s)
                traces.setdefault(peer, []).append((pair, trace))
        yield from world_rows(name, traces, _reference(portfolio, world, traces), skipped=missing())


def run_ours(machine: Portfolio | RRTStar, world: World, pair: int, *, seed: int, budget_s: float) -> Trace:
    """CPU time and length of every better way; checks the last by exact traversal."""
    start, goal = world.ends[pair]
    rng, trace = np.random.default_rng([seed, pair]), Trace()
    query = Query(start=start, goal=goal, space=world.space, rng=rng, iterations=_MOST_SAMPLES)
    started = time.process_time()
    search = machine.begin(query)
    spent = 0.0
    while spent < budget_s:
        search.advance(rng)
        spent = time.process_time() - started
        if search.cost_m < (trace[-1][1] - 1e-9 if trace else math.inf):
            trace.append((spent, search.cost_m))
    if trace and not world.space.path_free(search.result().path):
        raise AssertionError(f"{world.name}, pair {pair}, seed {seed}: the way is not free")
    return trace


def _reference(portfolio: Portfolio, world: World, traces: Traces) -> list[float]:
    """Shortest length known for each pair, m: of long runs and of all that was measured."""
    best = [math.inf] * len(world.ends)
    for pair in range(len(world.ends)):
        for seed in range(_LONG_RUNS):
            trace = run_ours(portfolio, world, pair, seed=100 + seed, budget_s=_LONG_S)
            best[pair] = min(best[pair], trace[-1][1])
    for runs in traces.values():
        for pair, trace in runs:
            best[pair] = min([best[pair], *(length for _, length in trace)])
    return best


def _enclosed(portfolio: Portfolio) -> PlanningRow:
    space, (start, goal) = enclosed_goal()
    spent: list[float] = []
    for seed in range(5):
        started = time.process_time()
        plan = portfolio.plan(start, goal, space, rng=np.random.default_rng(seed), iterations=1000)
        spent.append(1e3 * (time.process_time() - started))
    return enclosed_row(plan.proof, max(spent), float(np.median(spent)))
