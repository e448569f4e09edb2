"""Local maps drawn from formulas: ground planes, trunks, walls."""

from functools import cache

import numpy as np

from companion.core.messages import LocalMap, freeze
from companion.mapping.voxel_map import FREE_CELL, OCCUPIED_CELL, UNKNOWN_CELL

CELL_M = 0.2


def plane_map(*, shape=(80, 80, 40), origin=(-8.0, -8.0, -2.0), slope=(0.0, 0.0), height=0.0):
    """Ground z = height + slope . xy, occupied cells there, free above, unknown below."""
    xy = np.array(origin[:2]) + (np.stack(np.meshgrid(*map(np.arange, shape[:2]), indexing="ij"), -1) + 0.5) * CELL_M
    ground = height + xy @ np.array(slope)
    level = np.floor((ground - origin[2]) / CELL_M).astype(int)
    k = np.arange(shape[2])
    state = np.where(k == level[..., None], OCCUPIED_CELL, np.where(k > level[..., None], FREE_CELL, UNKNOWN_CELL))
    return made(state, origin, ground)


def made(state, origin, ground):
    none = np.zeros((0, 0, 0), np.float32)
    return freeze(
        LocalMap(
            stamp_ns=0,
            origin_odom=np.array(origin, float),
            resolution_m=CELL_M,
            state=state.astype(np.uint8),
            distance_m=none,
            unknown_distance_m=none.copy(),
            ground_z_odom=ground.astype(np.float32),
        )
    )


@cache
def _middles(shape):
    return (np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), -1) + 0.5) * CELL_M


def with_cells(local_map, inside, state=OCCUPIED_CELL, *, hides_ground=False):
    """A copy in which cells whose centres (X, Y, Z, 3) are `inside` have `state`."""
    states, ground = local_map.state.copy(), local_map.ground_z_odom.copy()
    chosen = inside(local_map.origin_odom + _middles(states.shape))
    states[chosen] = state
    if hides_ground:
        ground[chosen.any(axis=2)] = np.nan
    return made(states, local_map.origin_odom, ground)


def cylinder(x, y, radius_m, low, high):
    """Cells that a standing cylinder's mantle touches: centres within half a cell of it, or its axis' own."""

    def inside(centers):
        away = np.hypot(centers[..., 0] - x, centers[..., 1] - y)
        touched = np.abs(away - radius_m) <= CELL_M / 2
        return touched & (centers[..., 2] >= low) & (centers[..., 2] <= high)

    return inside


def box(low, high):
    return lambda centers: np.all((centers >= low) & (centers <= high), axis=-1)
