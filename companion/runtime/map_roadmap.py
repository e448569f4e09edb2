"""A roadmap through a whole map, kept in its file: many ways through one forest.

space = whole_space(stored_map, radius_m=0.76)
stored_map = with_roadmap(stored_map, space, samples=3000, seed=0)
plan = roadmap_of(stored_map).query(start, goal, space)
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.ndimage import distance_transform_edt

from companion.core.errors import InputError
from companion.mapping.formats.stored_map import StoredMap
from companion.mapping.rays import BLOCK
from companion.mapping.sensor_model import UNKNOWN
from companion.planning.grid_space import GridSpace
from companion.planning.roadmap import Roadmap, RoadmapConfig, build_roadmap

SECTION = "roadmap"
MOST_CELLS = 300_000_000  # of the box around the map


def whole_space(stored_map: StoredMap, *, radius_m: float) -> GridSpace:
    """Known free cells at least `radius_m` from occupied ones; what is unknown is blocked.

    Raises InputError if the map is empty, or too wide to lie open in memory.
    """
    xyz = stored_map.block_xyz.astype(np.int64)
    if not len(xyz):
        raise InputError("the map is empty", field="map")
    low, high = xyz.min(axis=0), xyz.max(axis=0) + 1
    shape = (high - low) * BLOCK
    if np.prod(shape, dtype=np.float64) > MOST_CELLS:
        raise InputError(f"{shape} cells are too many", field="map", valid=f"a box of at most {MOST_CELLS:,} cells")
    steps = np.full(shape, UNKNOWN, np.int8)
    for (i, j, k), block in zip((xyz - low) * BLOCK, stored_map.log_odds, strict=True):
        steps[i : i + BLOCK, j : j + BLOCK, k : k + BLOCK] = block.reshape(BLOCK, BLOCK, BLOCK)
    resolution_m = stored_map.resolution_m
    gap_m = (distance_transform_edt(steps < 0).astype(np.float32) - 0.5) * resolution_m
    blocked = (steps == UNKNOWN) | (gap_m < radius_m - 1e-4)
    origin = low * BLOCK * resolution_m
    return GridSpace(blocked, resolution_m=resolution_m, origin=origin, distance_m=gap_m)


def with_roadmap(
    stored_map: StoredMap, space: GridSpace, *, samples: int, seed: int, config: RoadmapConfig | None = None
) -> StoredMap:
    """The map with a section that holds a roadmap of PRM*; another one is replaced."""
    rng = np.random.default_rng(seed)
    roadmap = build_roadmap(space, rng=rng, samples=samples, config=config or RoadmapConfig(), star=True)
    return replace(stored_map, sections={**stored_map.sections, SECTION: roadmap.to_bytes()})


def roadmap_of(stored_map: StoredMap) -> Roadmap:
    """The roadmap in a map; InputError if there is none, or if it is damaged."""
    data = stored_map.sections.get(SECTION)
    if data is None:
        raise InputError("this map has no roadmap", field="map", valid="after: companion map roadmap FILE")
    return Roadmap.from_bytes(data)
