"""Finds a route on one local map: escape if the start is too near to something, aim, plan.

It is planned with all the clearance asked for; only where that finds nothing with less, down
to a least clearance.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Annotated

import msgspec
import numpy as np

from companion.core.messages import Array, Array32, Limits, LocalMap
from companion.planning.planner import Plan, Planner, PlannerName
from companion.planning.polyline import length
from companion.planning.space import FieldSpace
from companion.planning.target import place_for

Metres = Annotated[float, msgspec.Meta(ge=0)]
Share = Annotated[float, msgspec.Meta(gt=0, le=1)]
Count = Annotated[int, msgspec.Meta(ge=1)]


class RouteConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """How a route is looked for."""

    planner: PlannerName = "portfolio"
    """Which planner looks for it."""
    map_margin_m: Metres = 0.1
    """Added to the clearance: cells are coarse."""
    clearance_shares: tuple[Share, ...] = (1.0, 0.75, 0.5)
    """Shares of clearance and margin to plan with, one after the other, until a way is found."""
    least_clearance_m: Metres = 0.15
    """Hull to obstacle in the map, the least ever planned with."""
    iterations: Count = 1000
    """Samples per plan; searches of a lattice need no bound."""
    border_margin_m: Metres = 1.0
    """Stay this far from the border of the local map."""
    substitute_m: Metres = 4.0
    """A blocked goal may be replaced by a free place this near (if_blocked: nearest_free)."""
    escape_m: Metres = 2.0
    """How far to look for free space from a start that is too near to an obstacle."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Route:
    """A free way; `escape` (M, 3) leads from the start to free space, `path` from there on."""

    escape: Array
    path: Array  # (N, 3)
    cost_m: float  # of both
    iterations: int
    target: Array  # (3,) last point of `path`
    at_border: bool  # the goal lies beyond the local map
    substitute: bool  # the goal itself is not free: target is the nearest free place
    space: FieldSpace  # that it was planned in


class Spaces:
    """One map for several radii, widest first; the narrower are built when they are asked for."""

    def __init__(self, widest: FieldSpace, radii_m: list[float]) -> None:
        self._built, self._radii_m = [widest], radii_m

    @property
    def widest(self) -> FieldSpace:
        """With all the clearance asked for."""
        return self._built[0]

    def __iter__(self) -> Iterator[FieldSpace]:
        yield self._built[0]
        for n, radius_m in enumerate(self._radii_m, start=1):
            if len(self._built) == n:
                self._built.append(self._built[0].with_radius(radius_m))
            yield self._built[n]


class RouteFinder:
    """Asks a planner; an answer depends on the arguments alone."""

    def __init__(self, config: RouteConfig, planner: Planner, *, hull_radius_m: float) -> None:
        self.config, self.hull_radius_m = config, hull_radius_m
        self._planner = planner
        self.proven = False
        """Did the last `find` prove that no way leads to a goal inside the map, even with the least clearance?"""

    def radii_m(self, limits: Limits) -> list[float]:
        """Planning radii, widest first."""
        wide = limits.clearance + self.config.map_margin_m
        return [
            self.hull_radius_m + max(share * wide, min(wide, self.config.least_clearance_m))
            for share in self.config.clearance_shares
        ]

    def least_radius_m(self, limits: Limits) -> float:
        """The narrowest planning radius."""
        return min(self.radii_m(limits))

    def spaces(self, local_map: LocalMap, ground_z: Array32 | None, limits: Limits) -> Spaces:
        """The same map with shrinking clearance."""
        agl_m, radii = (limits.agl_min, limits.agl_max), self.radii_m(limits)
        widest = FieldSpace(local_map, radius_m=radii[0], ground_z=ground_z, agl_m=agl_m, unknown=limits.unknown)
        return Spaces(widest, radii[1:])

    def find(
        self,
        spaces: Spaces,
        start: Array,
        goal: Array,
        *,
        accept_m: float,
        rng: np.random.Generator,
        known_path: Array | None = None,
        before: Array | None = None,
    ) -> Route | None:
        """Route to within `accept_m` of the goal, or to the border of the map; None: not found.

        `before` is the place that stood for the goal so far, if it was not free.
        """
        for space in spaces:
            self.proven = False
            escape = escape_from(start, space, within_m=self.config.escape_m)
            margin_m = self.config.border_margin_m
            place = place_for(goal, space, start, within_m=accept_m, margin_m=margin_m, before=before)
            if escape is None or place is None:
                continue
            target, at_border = place
            plan = self._planner.plan(
                escape[-1], target, space, rng=rng, iterations=self.config.iterations, known_path=known_path
            )
            self.proven = plan.proof == "infeasible" and not at_border
            if plan.solved:
                off = float(np.linalg.norm(target - goal))
                return _route(escape, plan, space, at_border=at_border, substitute=not at_border and off > 0.1)
        return None

    def extend(self, route: Route, goal: Array, *, most_m: float, rng: np.random.Generator) -> Array:
        """The way (N, 3) from a route's target towards the goal after it; one point: none found."""
        space, target = route.space, route.target
        place = place_for(goal, space, target, within_m=0.5, margin_m=self.config.border_margin_m)
        if place is None:
            return target[None]
        plan = self._planner.plan(target, place[0], space, rng=rng, iterations=300)
        if not plan.solved or length(plan.path) < 1e-6:
            return target[None]
        return shortened(plan.path, most_m)


def _route(escape: Array, plan: Plan, space: FieldSpace, *, at_border: bool, substitute: bool) -> Route:
    return Route(
        escape=escape,
        path=plan.path,
        cost_m=length(escape) + plan.cost_m,
        iterations=plan.iterations,
        target=plan.path[-1],
        at_border=at_border,
        substitute=substitute,
        space=space,
    )


def shortened(path: Array, most_m: float) -> Array:
    """The beginning of a path (N, 3), at most `most_m` long."""
    left = most_m
    for n in range(1, len(path)):
        way = path[n] - path[n - 1]
        step = float(np.linalg.norm(way))
        if step >= left:
            return np.vstack([path[:n], path[n - 1] + way * (left / max(step, 1e-9))])
        left -= step
    return path


def escape_from(start: Array, space: FieldSpace, *, within_m: float) -> Array | None:
    """Straight way (N, 3) to the nearest free place that never comes nearer to an obstacle.

    One point if the start is free. If no straight way is that good, the one whose nearest
    approach is farthest. None: nothing free near.
    """
    if space.contains(start) and bool(space.free(start[None])[0]):
        return start[None].copy()
    places = space.free_cells_near(start, within_m=within_m)[:200]
    if not len(places):
        return None
    here = float(space.distance(start[None])[0])
    best, best_distance = places[0], -1.0
    for place in places:
        way = start + np.linspace(0.0, 1.0, 9)[:, None] * (place - start)
        nearest = float(space.distance(way).min())
        if nearest > best_distance + 1e-3:
            best, best_distance = place, nearest
        if nearest >= here - 0.05:
            break
    return np.stack([start, best])
