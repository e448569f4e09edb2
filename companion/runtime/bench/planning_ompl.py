"""OMPL's planners in our worlds, through the wheel `ompl`: the same exact check of edges, CPU time, in slices.

The wheel reports no intermediate solutions. So `solve` is called again and again for slices that grow, which goes on
with the same tree, and the best length is read between them; that reading is not charged. AORRTC starts anew for each
budget instead. The checks are charged with what Python adds to them, about two microseconds each. Every run is a
child process: AORRTC of wheel 2.0.1 crashes in some runs, which then count as without a way.
"""

from __future__ import annotations

import importlib.util
import multiprocessing
import time
from multiprocessing.connection import Connection
from typing import Any

import numpy as np

from companion.core.messages import Array
from companion.planning.grid import segment_free
from companion.planning.planner import CellSpace

PEERS = ("RRTConnect", "AORRTC", "InformedRRTstar", "RRTstar", "BITstar")
Trace = list[tuple[float, float]]  # CPU seconds, length in m, each shorter than the one before
_FIRST_SLICE_S, _GROWTH = 1e-4, 1.2
_WARM_S = 0.02
_FRESH_S = (0.0003, 0.0006, 0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5)


def missing() -> str:
    """Why there are no peers, or nothing."""
    return "" if importlib.util.find_spec("ompl") else "the wheel `ompl` is not there: pip install 'understory[bench]'"


def run_peer(name: str, space: CellSpace, start: Array, goal: Array, *, seed: int, budget_s: float) -> Trace:
    """What one of PEERS finds within so much CPU time."""
    if name != "AORRTC":
        return _in_child((name, space, start, goal, seed, budget_s, False))
    trace: Trace = []
    for fresh_s in (*(s for s in _FRESH_S if s < budget_s), budget_s):
        for spent, length in _in_child((name, space, start, goal, seed, fresh_s, True)):
            if not trace or length < trace[-1][1] - 1e-9:
                trace.append((spent, length))
    return trace


def _in_child(job: tuple[Any, ...]) -> Trace:
    """Empty if the child crashes."""
    context = multiprocessing.get_context("fork")
    here, there = context.Pipe(duplex=False)
    child = context.Process(target=_work, args=(there, *job))
    child.start()
    there.close()
    try:
        trace: Trace = here.recv()
    except EOFError:
        trace = []
    child.join()
    return trace


def _work(
    answer: Connection, name: str, space: CellSpace, start: Array, goal: Array, seed: int, budget_s: float, once: bool
) -> None:
    from ompl import util

    util.setLogLevel(util.LogLevel.LOG_NONE)
    util.RNG.setSeed(seed + 1)
    ends = space.to_cells(np.stack([start, goal]))
    _Problem(space, *ends).connect_and_simplify(_WARM_S)  # not counted, as before runs of our own planners
    problem = _Problem(space, *ends)
    if name == "RRTConnect":
        answer.send(problem.connect_and_simplify(budget_s))
    else:
        answer.send(problem.in_slices(name, budget_s, first_s=budget_s if once else _FIRST_SLICE_S))


class _Problem:
    """OMPL's objects for one query; lengths are in cells inside."""

    def __init__(self, space: CellSpace, start: Array, goal: Array) -> None:
        from ompl import base

        self._base, self._space, steps = base, space, space.steps
        states, bounds = base.RealVectorStateSpace(3), base.RealVectorBounds(3)
        for axis, (low, high) in enumerate(space.sample_box.T):
            bounds.setLow(axis, float(low))
            bounds.setHigh(axis, float(high) - 1e-6)
        states.setBounds(bounds)
        self.information = base.SpaceInformation(states)
        self._motions = _motion_validator(base, self.information, steps)
        self.information.setStateValidityChecker(lambda q: bool(steps[int(q[0]), int(q[1]), int(q[2])]))
        self.information.setMotionValidator(self._motions)
        self.information.setup()
        self.definition = base.ProblemDefinition(self.information)
        self._least = float(np.linalg.norm(goal - start))
        ends = [states.allocState(), states.allocState()]
        for axis in range(3):
            ends[0][axis], ends[1][axis] = float(start[axis]), float(goal[axis])
        self.definition.setStartAndGoalStates(*ends)
        self.definition.setOptimizationObjective(base.PathLengthOptimizationObjective(self.information))

    def in_slices(self, name: str, budget_s: float, *, first_s: float) -> Trace:
        """An anytime planner, until the time is over."""
        planner = self._planner(name)
        trace: Trace = []
        spent, until = 0.0, first_s
        while spent < budget_s:
            spent += self._solve(planner, until - spent)
            self._note(trace, spent)
            until = max(until * _GROWTH, spent)
        return trace

    def connect_and_simplify(self, budget_s: float) -> Trace:
        """RRTConnect, then OMPL's simplifier to the end."""
        from ompl import geometric

        trace: Trace = []
        spent = self._solve(self._planner("RRTConnect"), budget_s)
        self._note(trace, spent)
        if trace:
            path = self.definition.getSolutionPath()
            started = time.process_time()
            geometric.PathSimplifier(self.information).simplifyMax(path)
            spent += time.process_time() - started
            self._add(trace, spent, path.length())
        return trace

    def _planner(self, name: str) -> Any:
        from ompl import geometric

        planner = getattr(geometric, name)(self.information)
        planner.setProblemDefinition(self.definition)
        planner.setup()
        return planner

    def _solve(self, planner: Any, for_s: float) -> float:
        started = time.process_time()
        planner.solve(self._base.PlannerTerminationCondition(lambda: time.process_time() - started > for_s))
        return time.process_time() - started

    def _note(self, trace: Trace, spent: float) -> None:
        if not self.definition.hasExactSolution():
            return
        self._add(trace, spent, self.definition.getSolutionPath().length())

    def _add(self, trace: Trace, spent: float, cells: float) -> None:
        """A way that is the shortest yet. Once in some thousand runs OMPL has one of no length: that is none."""
        length = cells * self._space.resolution_m
        if cells > self._least - 1e-6 and (not trace or length < trace[-1][1] - 1e-9):
            trace.append((spent, length))


def _motion_validator(base: Any, information: Any, steps: Any) -> Any:
    """OMPL asks our kernel whether an edge is free."""
    p, q = np.empty(3), np.empty(3)

    class Exact(base.MotionValidator):  # type: ignore[misc]
        def checkMotion(self, a: Any, b: Any, lastValid: Any = None) -> bool:
            p[0], p[1], p[2] = a[0], a[1], a[2]
            q[0], q[1], q[2] = b[0], b[1], b[2]
            return bool(segment_free(steps, p, q))

    return Exact(information)
