"""Several planners that help each other: the straight line, RRT-Connect, a wave, a coarse-to-fine lattice, RRT*.

A first way comes from RRT-Connect, which is fast where there is room. If a few samples do not find one, a wave from the
goal finds the way around all walls, unless that is narrower than two cells. Then a flood fill says whether there is a
way at all, and Lazy Theta* looks for it from coarse to fine, beside RRT-Connect. From then on RRT* and shortcuts better
the way, and the lattices, which the wave guides, look for shorter ones elsewhere. Where no wave was needed, detours
past the other sides of what is in the way, and further ways of RRT-Connect, find the shortest side of each trunk.

>>> planner = Portfolio(PortfolioConfig(), RRTStarConfig())
>>> plan = planner.plan(start, goal, space, rng=np.random.default_rng(1), iterations=1000)
"""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated

import msgspec
import numpy as np

from companion.planning.lazy_theta import COARSEST, NO_GUIDE, LazyTheta
from companion.planning.planner import CellSpace, Plan, Planner, Query
from companion.planning.reach import Reach
from companion.planning.rrt_star import RRTStar, RRTStarConfig, Search
from companion.planning.wave import Wave

Count = Annotated[int, msgspec.Meta(ge=1)]
_LEVELS = ((2, COARSEST), (1, COARSEST), (0, COARSEST), (0, 0))
"""Finest and coarsest lattice of the searches, one after the other; the last has every cell."""
_FEW_SHORTCUTS = 20  # at once: most of what is gained is gained by looking straight on
_BLOCK = 2  # cells; blocks that are free as a whole carry the wave
_WAVE_SHARE = 0.94  # of a wave's layers: at most the distance
_ROOM_COLUMNS = 4000  # columns of a small room, counted each time that it spreads


class PortfolioConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Who works how much."""

    alone: Count = 300
    """Samples of RRT-Connect before a wave is sent, and then the lattice helps."""
    hard_expansions: Count = 400
    """Expansions of the lattice per round while there is no way."""
    guided_expansions: Count = 100
    """And per round beside RRT*, in worlds where a wave was needed for the first way."""
    easy_expansions: Count = 10
    """And in easy ones."""
    restarts: Annotated[int, msgspec.Meta(ge=0)] = 2
    """Chunks of RRT-Connect that look for other first ways in easy worlds, before RRT* betters the best."""
    restart_every: Count = 2
    """One more of them in every so many rounds after that."""
    first_shortcuts: Count = 200
    """Attempts to shorten what RRT-Connect or the lattice found."""
    detours: Annotated[int, msgspec.Meta(ge=0)] = 120
    """Attempts per round, at most, to pass obstacles on their other side, in easy worlds."""
    detour_m: Annotated[float, msgspec.Meta(gt=0)] = 30.0
    """From this far before an obstacle, at most, to this far behind."""
    greed: Annotated[float, msgspec.Meta(ge=1)] = 3.0
    """Weight of the straight distance in the lattice while there is no way; then 1."""


class Portfolio(Planner):
    """Keeps only scratch memory, so a plan depends on its arguments alone."""

    straight_first = True

    def __init__(self, config: PortfolioConfig, rrt_star: RRTStarConfig) -> None:
        self.config = config
        self._rrt_star, self._lattice = RRTStar(rrt_star), LazyTheta()

    def search(self, query: Query) -> Plan:
        """Shortest way found with at most `iterations` samples, in whole chunks; none: Plan.proof is `infeasible`.

        If a way exists it is found, however few the samples: the lattice ends by itself. With more iterations and
        the same `rng` state the cost never rises.
        """
        search = self.begin(query)
        while search.samples < query.iterations or not search.ended:
            search.advance(query.rng)
            if search.infeasible:
                break
        return search.result()

    def begin(self, query: Query) -> PortfolioSearch:
        """A search to be advanced in portions; it uses this planner's memory, so one at a time."""
        return PortfolioSearch(self.config, self._rrt_star.begin(query), self._lattice, query.space)


class PortfolioSearch:
    """One run in rounds: `advance` until it is `infeasible`, or good enough."""

    def __init__(self, config: PortfolioConfig, tree: Search, lattice: LazyTheta, space: CellSpace) -> None:
        self._config, self._tree, self._lattice, self._space, self._ends = config, tree, lattice, space, tree.ends
        self._levels = list(_LEVELS)
        self._looking = False
        self._reach: Reach | None = None
        self._joined: bool | None = None  # do free cells lead to the goal? None: not known yet
        self._is_swept = False  # was a wave sent?
        self._guide = NO_GUIDE
        self._early = [_FEW_SHORTCUTS, config.first_shortcuts]  # attempts to shorten the first way, round by round
        self._detours = config.detours
        self.samples = self._restarts = self._rounds = 0

    @property
    def solved(self) -> bool:
        """Is there a way?"""
        return self._tree.solved

    @property
    def infeasible(self) -> bool:
        """Is it proven that there is no way?"""
        return self._joined is False

    @property
    def ended(self) -> bool:
        """Is it known whether there is a way?"""
        return self.solved or self.infeasible

    @property
    def cost_m(self) -> float:
        """Length of the best way; infinite: none yet."""
        return self._tree.cost_m

    def advance(self, rng: np.random.Generator) -> None:
        """One round: one chunk of samples, and a portion of the lattice; a first way is shortened in the next."""
        tree, config = self._tree, self._config
        self.samples += tree.config.chunk
        if self.solved:
            self._better(rng)
            return
        tree.first(rng)
        if self.solved:
            self._looking = False  # a greedy search is of no more use
        elif self.samples >= config.alone and not self._is_enclosed() and not self._sweep(rng):
            self._look(config.hard_expansions, rng)

    def _better(self, rng: np.random.Generator) -> None:
        if self._early:
            self._tree.shorten(rng, self._early.pop(0))
            return
        config = self._config
        if not self._is_swept and self._restarts < config.restarts:
            self._restarts += 1
            self._tree.join(rng)
            return
        self._look(config.guided_expansions if self._is_swept else config.easy_expansions, rng)
        if not self._is_swept:
            self._take_detours(rng)
            self._rounds += 1
            if self._rounds % config.restart_every == 0:
                self._tree.join(rng)
        self._tree.grow(rng)
        self._tree.shorten(rng)

    def _take_detours(self, rng: np.random.Generator) -> None:
        """Half as many attempts, down to a few, after a round in which they were of no use."""
        before = self.cost_m
        self._tree.detour(rng, self._detours, reach_m=self._config.detour_m)
        most = self._config.detours
        self._detours = most if self.cost_m < before - 1e-6 else max(self._detours // 2, most // 8)

    def _sweep(self, rng: np.random.Generator) -> bool:
        """Once: the way down a wave of coarse blocks, if it comes to the start."""
        if self._is_swept:
            return False
        self._is_swept, wave = True, Wave(self._space.steps, self._ends, block=_BLOCK)
        if wave.reached:
            self._guide = np.ascontiguousarray(wave.layers), _BLOCK, _WAVE_SHARE
            self._tree.offer(wave.path(), rng, self._config.first_shortcuts)
        return self.solved

    def _look(self, expansions: int, rng: np.random.Generator) -> None:
        """Search on; a lattice that has ended makes room for the next finer one."""
        if not self._levels:
            return
        if not self._looking:
            self._begin_level()
        state = self._lattice.advance(expansions)
        if state == "open":
            return
        self._looking, was_first = False, not self.solved
        if state == "found":
            self._tree.offer(self._lattice.path(), rng, self._config.first_shortcuts)
        if state == "exhausted" or not was_first:
            self._levels.pop(0)
        if not self.solved and self._joined is None and self._reach is not None:
            self._joined = self._reach.joined()

    def _begin_level(self) -> None:
        self._looking, most = True, self._tree.best_cost
        weight = 1.0 if self.solved else self._config.greed
        steps, levels = self._space.steps, self._levels[0]
        self._lattice.begin(steps, self._ends, levels=levels, weight=weight, most=most, guide=self._guide)

    def _is_enclosed(self) -> bool:
        """A small room around the goal is found at once; a large one when the coarsest lattice has found no way."""
        if self._reach is None:
            start, goal = np.floor(self._ends).astype(np.int64)
            self._reach = Reach(self._space.steps, start, goal)
            self._joined = self._reach.joined(most_columns=_ROOM_COLUMNS)
        return self.infeasible

    def result(self) -> Plan:
        """The best way, or the proof that there is none."""
        plan = self._tree.result(self.samples)
        return replace(plan, proof="infeasible") if self.infeasible else plan
