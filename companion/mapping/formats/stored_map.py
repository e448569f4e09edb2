"""A map at rest: the blocks and what they mean, without the machinery that fills them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from companion.core.errors import InputError
from companion.core.messages import Array, Array32
from companion.mapping.rays import BLOCK, CELLS
from companion.mapping.sensor_model import UNKNOWN, SensorModel, quantise
from companion.mapping.voxel_map import VoxelMap, VoxelMapConfig

FINEST_M, COARSEST_M = 1e-3, 1e3  # edges of a voxel that a file may name
_FARTHEST_BLOCK = 1 << 20  # of the hash of the living map


@dataclass(frozen=True, slots=True, eq=False)
class StoredMap:
    """Blocks at `block_xyz` (N, 3), each with 512 `log_odds` steps (N, 512), z fastest; -128: unknown.

    Block (i, j, k) holds cells 8 * (i, j, k) up to + 7; cell c spans [c, c + 1) * resolution_m.
    Maps in canonical form, as all readers give them, are ordered by position, x first, and
    hold no block without a known cell: equal maps have equal arrays. `sections` are further
    parts of a file by name, as bytes.
    """

    resolution_m: float
    sensor: SensorModel  # its int8 steps are `quantise(sensor)`
    block_xyz: NDArray[np.int32]
    log_odds: NDArray[np.int8]
    frame: str = "odom"
    created_by: str = ""
    sections: Mapping[str, bytes] = field(default_factory=dict)

    def canonical(self) -> StoredMap:
        """The same map in canonical form; InputError if it is none."""
        self._check()
        known = np.flatnonzero(np.any(self.log_odds != UNKNOWN, axis=1))
        xyz = self.block_xyz[known]
        order = np.lexsort(xyz.T[::-1])
        xyz = np.ascontiguousarray(xyz[order])
        if np.any(np.all(xyz[1:] == xyz[:-1], axis=1)):
            raise InputError("a block is there twice", field="block_xyz")
        return replace(self, block_xyz=xyz, log_odds=np.ascontiguousarray(self.log_odds[known[order]]))

    def probability(self) -> Array32:
        """P(occupied) (256,) by log-odds step, indexed by the step as uint8; NaN: unknown."""
        steps = np.arange(256, dtype=np.uint8).view(np.int8).astype(np.float64)
        p = 1.0 / (1.0 + np.exp(-steps / quantise(self.sensor).per_unit))
        return np.where(steps == UNKNOWN, np.nan, p).astype(np.float32)

    def occupied(self) -> tuple[Array, Array32]:
        """Centres (K, 3) of the occupied cells, m, and P(occupied) (K,)."""
        row, cell = np.nonzero(self.log_odds >= 0)
        inside = np.stack([cell >> 6, (cell >> 3) & 7, cell & 7], axis=1)
        centers = np.asarray((BLOCK * self.block_xyz[row].astype(np.int64) + inside + 0.5) * self.resolution_m)
        return centers, self.probability()[self.log_odds[row, cell].view(np.uint8)]

    def to_voxels(self, config: VoxelMapConfig) -> VoxelMap:
        """The living map; InputError when `config` has another resolution or sensor model."""
        model = self.sensor
        arrays = {
            "resolution_m": np.array(self.resolution_m),
            "sensor_model": np.array([model.hit, model.miss, model.lowest, model.highest]),
            "block_xyz": self.block_xyz,
            "log_odds": self.log_odds,
        }
        return VoxelMap.from_arrays(arrays, config)

    def _check(self) -> None:
        xyz, log_odds = self.block_xyz, self.log_odds
        if not FINEST_M <= self.resolution_m <= COARSEST_M:
            raise InputError(f"{self.resolution_m} m", field="resolution_m", valid=f"{FINEST_M:g} to {COARSEST_M:g} m")
        if xyz.shape != (len(xyz), 3) or log_odds.shape != (len(xyz), CELLS) or log_odds.dtype != np.int8:
            raise InputError(f"shapes {xyz.shape}, {log_odds.shape} {log_odds.dtype} are no map", field="log_odds")
        if np.any(np.abs(xyz.astype(np.int64)) >= _FARTHEST_BLOCK):
            raise InputError("a block is too far out", field="block_xyz", valid=f"within {_FARTHEST_BLOCK - 1}")


def stored(voxels: VoxelMap, *, created_by: str = "", sections: Mapping[str, bytes] | None = None) -> StoredMap:
    """A canonical copy of the living map, evicted blocks included."""
    arrays = voxels.to_arrays()
    return StoredMap(
        resolution_m=voxels.resolution_m,
        sensor=voxels.config.sensor,
        block_xyz=arrays["block_xyz"],
        log_odds=arrays["log_odds"],
        created_by=created_by,
        sections=dict(sections or {}),
    ).canonical()
