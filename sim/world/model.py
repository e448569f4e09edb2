"""A finished world: stems, cones, ground and triangles, with the start at the origin on the ground."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from companion.core.messages import Array
from sim.world.columns import Columns
from sim.world.mesh import Mesh
from sim.world.reach import first_hit
from sim.world.terrain import heights_at
from sim.world.walkers import NOBODY, Walkers
from sim.world.walls import NO_WALLS, Walls

TRUNK_CONE, BRANCH_CONE = 0, 1


@dataclass(frozen=True, eq=False)
class Stems:
    """The stand as a forester lists it; all arrays (N,), m."""

    x: Array
    y: Array
    z_ground: Array
    dbh_m: Array  # diameter 1.3 m above ground
    height_m: Array

    def __len__(self) -> int:
        return len(self.x)


@dataclass(frozen=True)
class Air:
    """What light and air leave of the sensors; see sim/world/spec.py."""

    light: float = 1.0
    dust: float = 0.0
    lidar_loss: float = 0.0


CLEAR = Air()


@dataclass(frozen=True, eq=False)
class World:
    """World frame: ENU, z up, origin at the start on the ground. Arrays are read-only."""

    name: str
    seed: int
    bounds: tuple[float, float, float, float]  # of the stand: x_min, y_min, x_max, y_max
    stems: Stems
    cones: Array  # (M, 9): base xyz, unit axis xyz, length, radius at base, radius at tip; side only
    kinds: NDArray[np.int8]  # (M,), TRUNK_CONE or BRANCH_CONE
    heights: Array  # (nx, ny) of the ground at origin_xy + (i, j) * cell_m
    origin_xy: Array  # (2,)
    cell_m: float
    mesh: Mesh
    grid: Columns  # which cones touch which square metre
    walkers: Walkers = NOBODY  # what moves; everything else stands still
    walls: Walls = NO_WALLS  # racks, halls, rock
    air: Air = CLEAR

    def ground_z(self, x: Array | float, y: Array | float) -> Array:
        """Ground height, m, in the shape of x and y; beyond the field that of its rim."""
        xs, ys = np.broadcast_arrays(np.asarray(x, np.float64), np.asarray(y, np.float64))
        xy = np.stack([xs.ravel(), ys.ravel()], axis=1)
        return heights_at(self.heights, self.origin_xy, self.cell_m, xy).reshape(xs.shape)

    def range_to_surface(
        self, p_world: Array, direction: Array, *, max_range_m: float = 60.0, stamp_ns: int | None = None
    ) -> float:
        """Distance from p along a unit direction to ground, trunk, branch or wall; inf: none in range.

        With `stamp_ns` the walkers count, too, where they are at that time.
        """
        still_m = first_hit(self, p_world, direction, max_range_m)
        still_m = min(still_m, self.walls.first_hit(p_world, direction, min(still_m, max_range_m)))
        if stamp_ns is None or not len(self.walkers):
            return still_m
        walker_m = self.walkers.first_hit(p_world, direction, stamp_ns)
        return min(still_m, walker_m if walker_m <= max_range_m else math.inf)
