"""What a map holds, in figures."""

from __future__ import annotations

import msgspec
import numpy as np

from companion.mapping.formats.stored_map import StoredMap
from companion.mapping.rays import BLOCK
from companion.mapping.sensor_model import UNKNOWN, SensorModel

Triple = tuple[float, float, float]


class MapFacts(msgspec.Struct, frozen=True, kw_only=True):
    """Extent and volumes; `low_m` to `high_m` is the box of all known voxels."""

    resolution_m: float
    frame: str
    created_by: str
    sensor: SensorModel
    blocks: int
    occupied_voxels: int
    free_voxels: int
    occupied_m3: float
    free_m3: float
    known_m3: float
    low_m: Triple
    high_m: Triple
    sections: dict[str, int]  # name -> bytes

    @property
    def size_m(self) -> Triple:
        """Edges of the box."""
        x, y, z = (high - low for low, high in zip(self.low_m, self.high_m, strict=True))
        return (x, y, z)


def facts_of(stored: StoredMap) -> MapFacts:
    """The figures of a canonical map."""
    known = stored.log_odds != UNKNOWN
    occupied = int(np.count_nonzero(stored.log_odds >= 0))
    free = int(np.count_nonzero(known)) - occupied
    voxel_m3 = stored.resolution_m**3
    low, high = _box(stored)
    return MapFacts(
        resolution_m=stored.resolution_m,
        frame=stored.frame,
        created_by=stored.created_by,
        sensor=stored.sensor,
        blocks=len(stored.block_xyz),
        occupied_voxels=occupied,
        free_voxels=free,
        occupied_m3=round(occupied * voxel_m3, 6),
        free_m3=round(free * voxel_m3, 6),
        known_m3=round((occupied + free) * voxel_m3, 6),
        low_m=low,
        high_m=high,
        sections={name: len(data) for name, data in sorted(stored.sections.items())},
    )


def _box(stored: StoredMap) -> tuple[Triple, Triple]:
    """Corners of the box of known voxels, m; only blocks on the rim are looked into."""
    if len(stored.block_xyz) == 0:
        return (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
    low: list[float] = []
    high: list[float] = []
    for axis in range(3):
        place = stored.block_xyz[:, axis].astype(np.int64)
        for ends, rim, pick in ((low, place.min(), 0), (high, place.max(), -1)):
            cells = stored.log_odds[place == rim].reshape(-1, BLOCK, BLOCK, BLOCK) != UNKNOWN
            layers = np.flatnonzero(np.any(np.moveaxis(cells, axis + 1, 0).reshape(BLOCK, -1), axis=1))
            ends.append(round(float((BLOCK * rim + layers[pick] - pick) * stored.resolution_m), 9))
    return (low[0], low[1], low[2]), (high[0], high[1], high[2])
