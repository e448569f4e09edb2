"""All planners by name.

>>> planner = make_planner("astar", PlannerSettings())
"""

from __future__ import annotations

from collections.abc import Callable

import msgspec

from companion.core.errors import InputError
from companion.planning.lattice.planner import AStar, Dijkstra, LatticeConfig, ThetaStar
from companion.planning.planner import Planner
from companion.planning.portfolio import Portfolio, PortfolioConfig
from companion.planning.roadmap import PRM, PRMStar, RoadmapConfig
from companion.planning.rrt import RRT, RRTConfig, RRTConnect
from companion.planning.rrt_star import RRTStar, RRTStarConfig


class PlannerSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Settings of every planner, also of those that do not fly."""

    portfolio: PortfolioConfig = PortfolioConfig()
    rrt_star: RRTStarConfig = RRTStarConfig()
    rrt: RRTConfig = RRTConfig()
    roadmap: RoadmapConfig = RoadmapConfig()
    lattice: LatticeConfig = LatticeConfig()


PLANNERS: dict[str, Callable[[PlannerSettings], Planner]] = {
    "portfolio": lambda settings: Portfolio(settings.portfolio, settings.rrt_star),
    "rrt_star": lambda settings: RRTStar(settings.rrt_star),
    "rrt": lambda settings: RRT(settings.rrt),
    "rrt_connect": lambda settings: RRTConnect(settings.rrt),
    "prm": lambda settings: PRM(settings.roadmap),
    "prm_star": lambda settings: PRMStar(settings.roadmap),
    "dijkstra": lambda settings: Dijkstra(settings.lattice),
    "astar": lambda settings: AStar(settings.lattice),
    "theta_star": lambda settings: ThetaStar(settings.lattice),
}


def make_planner(name: str, settings: PlannerSettings) -> Planner:
    """The planner of that name; raises InputError that gives the valid names."""
    if name not in PLANNERS:
        raise InputError(f"{name!r} is no planner", field="planner", valid=", ".join(PLANNERS))
    return PLANNERS[name](settings)
