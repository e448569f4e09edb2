"""What the textbooks say of each planner; the measured numbers stand beside it."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Facts:
    """V cells, E moves between them, n samples, k neighbours of a sample."""

    optimal: str
    complete: str
    effort: str
    use: str


FACTS = {
    "dijkstra": Facts(
        "on its lattice",
        "at the cell size",
        "O(E + V log V); buckets: O(E + V)",
        "ways to all places from one; the yardstick of the others",
    ),
    "astar": Facts(
        "on its lattice, if the heuristic is admissible",
        "at the cell size",
        "as Dijkstra at worst, far less with a good heuristic",
        "known maps, few dimensions, a proof that there is no way",
    ),
    "theta_star": Facts(
        "no, but near the any-angle optimum",
        "at the cell size",
        "A* and a line of sight per move",
        "straight ways on a grid without smoothing",
    ),
    "prm": Facts(
        "no",
        "with probability 1 as n grows",
        "O(n log n + n k) to build, then O(n log n) per query",
        "many queries on one map that stays",
    ),
    "prm_star": Facts(
        "as n grows",
        "with probability 1 as n grows",
        "O(n log n) edges to build, then O(n log n) per query",
        "many queries, and short ways",
    ),
    "rrt": Facts(
        "no",
        "with probability 1 as n grows",
        "O(n log n)",
        "one query, many dimensions, any way at all",
    ),
    "rrt_connect": Facts(
        "no",
        "with probability 1 as n grows",
        "O(n log n)",
        "a first way, fast; what better planners begin with",
    ),
    "portfolio": Facts(
        "as n grows",
        "at the cell size: a flood fill proves that there is no way",
        "RRT-Connect, where that fails O(V) for a wave, then as RRT*",
        "flight: a first way at once also in hard places, then as RRT*",
    ),
    "rrt_star": Facts(
        "as n grows",
        "with probability 1 as n grows",
        "O(n log n), more per sample than RRT",
        "replanning in flight: stop whenever time is up, the way gets shorter until then",
    ),
}
