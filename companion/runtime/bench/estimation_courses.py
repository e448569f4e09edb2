"""Ways on which the estimators are measured: a tour of 300 m through a forest, and a ring in a clearing.

course = tour(cones, top_m_s=8.0)      # cones (M, 9) as the simulator's worlds have them
course = ring(top_m_s=4.0)
"""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np

from companion.core.errors import CompanionError
from companion.core.messages import Array
from companion.planning.planner import CellSpace
from companion.planning.registry import PlannerSettings, make_planner
from companion.planning.smooth import SmoothConfig, smooth
from companion.runtime.bench.tracking_courses import HEIGHT_M, free_near, paced, space_of
from companion.runtime.bench.tracking_pilot import Course

CORNERS_M = ((0, 0), (34, 8), (50, 38), (16, 50), (-20, 38), (-50, 18), (-42, -24), (-8, -46), (28, -42), (50, -18))
_EDGE_M = 62.0
RING_M = 24.0  # radius


def tour(cones: Array, *, top_m_s: float, seed: int = 1) -> Course:
    """The planner's way, smoothed, from above the origin around it; it crosses no place twice."""
    space = space_of(cones, (-_EDGE_M, -_EDGE_M), (_EDGE_M, _EDGE_M))
    places = [np.array([0.0, 0.0, HEIGHT_M])]
    places += [free_near(space, np.array([x, y, HEIGHT_M])) for x, y in CORNERS_M[1:]]
    legs = [_leg(space, a, b, seed=seed + k) for k, (a, b) in enumerate(pairwise(places))]
    path = np.concatenate([legs[0], *(leg[1:] for leg in legs[1:])])
    return paced("forest", smooth(path, space, SmoothConfig()), top_m_s=top_m_s, space=space)


def ring(*, top_m_s: float) -> Course:
    """Out of the middle of a clearing and once around it, 172 m."""
    turn = np.arange(0.0, 2 * math.pi, 0.02)
    out = np.column_stack([np.arange(0.0, RING_M, 0.5), np.zeros(round(RING_M / 0.5))])
    around = RING_M * np.column_stack([np.cos(turn), np.sin(turn)])
    level = np.concatenate([out, around])
    return paced("clearing", np.column_stack([level, np.full(len(level), HEIGHT_M)]), top_m_s=top_m_s)


def _leg(space: CellSpace, start: Array, goal: Array, *, seed: int) -> Array:
    planner = make_planner("rrt_star", PlannerSettings())
    plan = planner.plan(start, goal, space, rng=np.random.default_rng(seed), iterations=2000)
    if not plan.solved:
        raise CompanionError("no way through this forest: try another --seed")
    return plan.path
