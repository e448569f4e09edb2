"""Space that must be free because the vehicle itself is there."""

from __future__ import annotations

import numpy as np

from companion.core.messages import Array


def cells_around(p_odom: Array, *, radius_m: float, height_m: float, cell_m: float) -> Array:
    """Centres (K, 3) of the cells in a sphere around p, and in a column that stands on its middle.

    The column has the sphere's radius and reaches from p to p + height. A cell is in when its
    centre is; the cell that holds p always is.
    """
    low = np.floor((p_odom - radius_m) / cell_m)
    high = np.floor((p_odom + np.array([radius_m, radius_m, max(radius_m, height_m)])) / cell_m)
    axes = [(np.arange(a, b + 1) + 0.5) * cell_m for a, b in zip(low, high, strict=True)]
    centers = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    x, y, z = (centers - p_odom).T
    flat2 = x * x + y * y
    inside = flat2 + z * z <= radius_m**2
    inside |= (flat2 <= radius_m**2) & (z >= 0.0) & (z <= height_m)
    inside |= np.all(np.floor(centers / cell_m) == np.floor(p_odom / cell_m), axis=1)
    cells: Array = centers[inside]
    return cells
