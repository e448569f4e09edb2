"""Compile every kernel before the flight: neither the first scan nor the first far block waits for the compiler."""

from __future__ import annotations

import msgspec
import numpy as np

from companion.mapping.correction import warm_correction
from companion.mapping.decay import DecayConfig, decay
from companion.mapping.memory import MemoryConfig
from companion.mapping.share import warm_share
from companion.mapping.voxel_map import VoxelMap, VoxelMapConfig

_FAR_M = 1000.0


def warm_up(voxels: VoxelMap) -> None:
    """Run each on next to nothing; `voxels`, which is empty, stays so."""
    zero = np.zeros(3)
    voxels.insert(np.empty((0, 3), np.float32), R_odom_body=np.eye(3), p_odom=zero, origin_odom=zero)
    if voxels.blocks.marking:
        decay(voxels, 0, DecayConfig(), since_ns=0)
    warm_share(voxels)
    warm_correction(voxels.config)
    _warm_memory(voxels.config)


def _warm_memory(config: VoxelMapConfig) -> None:
    """A block is put away, asked for where it lies, and comes back."""
    voxels = VoxelMap(msgspec.structs.replace(config, memory=MemoryConfig(keep_m=0.0, spill=False)))
    point, nothing = np.array([[1.0, 0.0, 0.0]], np.float32), np.empty((0, 3), np.float32)
    for x_m, points in ((0.0, point), (_FAR_M, nothing), (0.0, nothing)):
        here = np.array([x_m, 0.0, 0.0])
        voxels.insert(points, R_odom_body=np.eye(3), p_odom=here, origin_odom=here)
        voxels.query(point.astype(np.float64))
