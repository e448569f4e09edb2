"""What the map says."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from companion.core.messages.kind import Array, Array32, message


@message
class LocalMap:
    """Immutable snapshot around the vehicle: what is known, and how far obstacles are."""

    stamp_ns: int
    origin_odom: Array  # corner of cell (0, 0, 0), m, (3,)
    resolution_m: float
    state: NDArray[np.uint8]  # 0 unknown, 1 free, 2 occupied, (X, Y, Z)
    distance_m: Array32  # to the nearest occupied cell's surface, truncated, (X, Y, Z)
    unknown_distance_m: Array32  # to the nearest cell that is not known free, truncated; (0, 0, 0): nobody asks for it
    ground_z_odom: Array32  # lowest ground seen per column, NaN: none, (X, Y)


@message
class Landmarks:
    """Single things of the feature map, one row each, ordered by id."""

    stamp_ns: int  # of the newest image inside
    id: NDArray[np.int64]  # (N,), never given twice
    position_odom: Array  # m, (N, 3); of a trunk: its axis at breast height
    sigma_m: Array  # root of the mean variance of the three axes, (N,)
    kind: NDArray[np.uint8]  # 0 visual, 1 trunk, (N,)
    radius_m: Array  # NaN: has none, (N,)
    observations: NDArray[np.int64]  # (N,)


@message
class MapStatus:
    """How old and how large the map is: for whoever needs no cells."""

    stamp_ns: int  # of the newest scan inside the newest local map
    scans: int  # taken in so far
    blocks: int  # of 8 x 8 x 8 voxels, alive
    cold_blocks: int  # of them, compressed because they are far
    forgotten_blocks: int  # dropped since the map began, because it did not fit the budget
    memory_bytes: int  # of the map


@message
class OccupiedVoxels:
    """The map as a viewer wants it."""

    stamp_ns: int  # of the newest scan inside
    points_odom: Array32  # centres of the occupied voxels, m, (N, 3)
    log_odds: Array32  # of being occupied, (N,)


@message
class MapDelta:
    """Blocks of 8 x 8 x 8 voxels whose classes changed; `companion.mapping.mirror` keeps a map by it."""

    stamp_ns: int  # of the newest scan inside
    map_ns: int  # stamp of the map's first scan: a map that begins anew counts versions anew
    version_from: int  # every block changed after this version is inside; 0: the whole map
    version_to: int
    resolution_m: float
    block_count: int
    data: bytes  # LZ4 frame of one record of 140 bytes per block, as in MapDelta.msg
