"""The distance field beside edt and scipy."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from companion.core.messages import Array32
from companion.mapping.distance_field import DistanceField, FieldConfig
from companion.mapping.voxel_map import OCCUPIED_CELL, VoxelMap
from companion.runtime.bench.mapping_insert import like_octomap
from companion.runtime.bench.mapping_peers import alternate, peer
from companion.runtime.bench.mapping_scans import Scan

FieldPeer = Literal["edt", "scipy"]
_CELL_M = 0.2
_ROUNDS = 4  # for each asked for: calls are short


def time_field(scans: list[Scan], peer_name: FieldPeer, *, rounds: int) -> dict[str, float]:
    """One distance, that to occupied cells, over the same states for both; and our whole snapshot.

    `max_error_m` is over all cells inside the truncation, from scipy's exact squares.
    """
    voxels = filled(scans)
    config = FieldConfig()
    field, center = DistanceField(config, resolution_m=_CELL_M), scans[-1].p_odom
    states = field.around(voxels, center, 0).state
    empty = np.ascontiguousarray(states != OCCUPIED_CELL)
    works = {
        "ours_ms": lambda: field.distance_to_occupied(states),
        "snapshot_ms": lambda: field.around(voxels, center, 0),
        "peer_ms": _peers_work(peer_name, empty),
    }
    best = alternate(works, rounds=_ROUNDS * rounds)
    error_m = _error_m(field.distance_to_occupied(states), empty, config.truncation_m)
    return {**best, "max_error_m": error_m, "cells": float(empty.size), "rounds": float(_ROUNDS * rounds)}


def filled(scans: list[Scan]) -> VoxelMap:
    """A map of 0.2 m with all scans in it."""
    voxels = VoxelMap(like_octomap(_CELL_M))
    for scan in scans:
        scan.into(voxels)
    return voxels


def _peers_work(name: FieldPeer, empty: NDArray[np.bool_]) -> Callable[[], object]:
    if name == "edt":
        return partial(peer("edt").edt, empty, parallel=1)
    return partial(peer("scipy.ndimage").distance_transform_edt, empty)


def _error_m(ours: Array32, empty: NDArray[np.bool_], truncation_m: float) -> float:
    """Largest difference from scipy's distance by the same rule: less half a cell, truncated."""
    cells = peer("scipy.ndimage").distance_transform_edt(empty)
    squares = np.rint(cells * cells).astype(np.float32)
    exact = np.clip((np.sqrt(squares) - np.float32(0.5)) * np.float32(_CELL_M), 0.0, np.float32(truncation_m))
    return float(np.max(np.abs(exact.astype(np.float32) - ours)))
