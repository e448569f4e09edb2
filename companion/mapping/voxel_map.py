"""Occupancy of the world from scans and poses: OctoMap's semantics, one update per voxel and scan."""

from __future__ import annotations

from collections.abc import Mapping
from copy import copy
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
from numpy.typing import NDArray

from companion.core.errors import InputError
from companion.core.messages import Array, Array32
from companion.mapping.blocks import BlockStore, Watch
from companion.mapping.cold_region import Blocks
from companion.mapping.end_voxels import end_voxels
from companion.mapping.memory import Memory, MemoryConfig
from companion.mapping.rays import BLOCK, CELLS
from companion.mapping.scan_rays import MapPool, ScanRays
from companion.mapping.sensor_model import UNKNOWN, SensorModel, quantise
from companion.mapping.shelf import Shelf

UNKNOWN_CELL, FREE_CELL, OCCUPIED_CELL = 0, 1, 2  # as in core.messages.LocalMap.state
_FARTHEST_M = 1e5  # where a float32 still tells centimetres, and far inside the hash's range
_FARTHEST_BLOCKS = 64  # of a ray: 300 MB of scratch, and bit numbers fit 32 bits
_NO_POINTS = np.empty((0, 3))
_NO_VECTORS = np.empty((0, 3), np.float32)
_Metres = Annotated[float, msgspec.Meta(gt=0.0)]


class VoxelMapConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Grain and reach of the map."""

    resolution_m: Annotated[float, msgspec.Meta(ge=0.02, le=2.0)] = 0.2  # edge of a voxel
    max_range_m: _Metres = 30.0  # longer rays clear up to here and hit nothing
    miss_clear_range_m: _Metres = 15.0  # beams without return clear up to here; at most max_range_m
    ray_per: Literal["point", "end_voxel"] = "point"
    """Rays of a scan: one to each point, or one to the centre of each voxel that holds points, OctoMap's discrete mode:
    faster where points are dense, but what the other rays cross is not seen."""
    sensor: SensorModel = SensorModel()
    memory: MemoryConfig = MemoryConfig()

    def __post_init__(self) -> None:
        if self.miss_clear_range_m > self.max_range_m:
            raise InputError(
                f"{self.miss_clear_range_m} m is farther than max_range_m",
                field="mapping.voxels.miss_clear_range_m",
                valid=f"up to {self.max_range_m} m",
            )
        if self.max_range_m > _FARTHEST_BLOCKS * BLOCK * self.resolution_m:
            raise InputError(
                f"{self.max_range_m} m is too far for voxels of {self.resolution_m} m",
                field="mapping.voxels.max_range_m",
                valid=f"up to {_FARTHEST_BLOCKS * BLOCK * self.resolution_m:g} m",
            )


@dataclass(frozen=True, slots=True, eq=False)
class Delta:
    """What one scan did to the map."""

    returns: int  # points that counted
    misses: int  # beams without return that counted
    dropped: int  # points and beams that were not finite, of no length, or on the own body
    voxel_steps: int  # voxels crossed, each ray counted
    blocks_met: int
    changed_blocks: NDArray[np.int32]  # (K, 3), where a voxel changed between unknown, free, occupied


class VoxelMap:
    """Unbounded map of voxels in `odom`; a voxel is unknown, free or occupied.

    >>> voxels = VoxelMap(VoxelMapConfig())
    >>> delta = voxels.insert(points, R_odom_body=R, p_odom=p, origin_odom=p)
    >>> voxels.classify(points + p)  # 0 unknown, 1 free, 2 occupied
    """

    def __init__(
        self,
        config: VoxelMapConfig,
        *,
        decays: bool = False,
        shelf: Shelf | None = None,
        map_pool: MapPool | None = None,
    ) -> None:
        """`decays`: `companion.mapping.decay` is called after every scan; `shelf`: where far blocks may lie.

        `map_pool`: as `map` of an Executor with two threads; they share the rays of a scan. The map is the same.
        """
        self.config = config
        self.resolution_m = config.resolution_m
        self.steps = quantise(config.sensor)
        self.shelf = shelf
        self.blocks = BlockStore(marking=decays)  # for the other files of this package
        self.memory = _memory(self)  # far blocks, compressed: `blocks` holds the rest
        self._rays = ScanRays(config.resolution_m, config.max_range_m, map_pool)

    @property
    def block_count(self) -> int:
        """Blocks of 8^3 voxels that hold a known voxel."""
        return self.blocks.count + self.memory.cold_blocks

    @property
    def version(self) -> int:
        """Grows with every change of the map."""
        return self.blocks.version

    def changed_since(self, version: int) -> NDArray[np.int32]:
        """Positions (K, 3) of the blocks in which a voxel changed its class after `version`."""
        return self.changes_since(version)[0]

    def changes_since(self, version: int) -> tuple[NDArray[np.int32], NDArray[np.int64]]:
        """The same, and for each the version (K,) of its last change, or one between that and `version`."""
        count, blocks = self.blocks.count, self.blocks
        rows = np.flatnonzero(blocks.changed_at[:count] > version)
        xyz, versions = self.memory.changes_since(version)
        return np.concatenate([blocks.xyz[rows], xyz]), np.concatenate([blocks.changed_at[rows], versions])

    @property
    def memory_bytes(self) -> int:
        """Bytes of the map; the fixed scratch of insertion is not counted."""
        return self.blocks.memory_bytes + self.memory.memory_bytes

    def insert(
        self,
        points_body: Array32,
        *,
        R_odom_body: Array,
        p_odom: Array,
        origin_odom: Array,
        miss_dirs_body: Array32 | None = None,
        free_odom: Array = _NO_POINTS,
        own_radius_m: float = 0.0,
        stamp_ns: int = 0,
        watch: Watch | None = None,
    ) -> Delta:
        """Take in one scan.

        Every voxel that a ray crosses on its way from `origin_odom` (3,) gets one miss, unless
        it holds a return: then one hit. `points_body` (N, 3) are returns, m, and
        `miss_dirs_body` (M, 3) directions of beams without return, both mapped to odom by
        `R_odom_body` (3, 3); `p_odom` (3,) is the body. The voxels of `free_odom` (K, 3), m,
        are free by other knowledge, up to `max_range_m`: one miss. Points nearer to the body's origin than
        `own_radius_m`, and what is not finite, is dropped. `stamp_ns` is when the scan was.
        `watch` sees which blocks the scan meets before they change (`companion.mapping.submaps`).
        Raises InputError when the pose is not finite or farther than 100 km.
        """
        R, p, origin = (np.asarray(a, np.float64) for a in (R_odom_body, p_odom, origin_odom))
        _check_pose(R=R, p_odom=p, origin_odom=origin)
        points = _rows(points_body)
        misses = _rows(_NO_VECTORS if miss_dirs_body is None else miss_dirs_body)
        self._rays.place(origin)
        grid = self._rays.grid
        self.memory.before_scan(grid.corner + grid.reach, grid.reach)
        hit, missed, steps = self._cast((points, own_radius_m), misses, (R, p - origin, origin))
        if len(free_odom):
            grid.mark_free(free_odom[np.linalg.norm(free_odom - origin, axis=1) <= self.config.max_range_m])
        met, changed = self.blocks.fold(grid, self.steps, stamp_ns, watch)
        return Delta(hit, missed, len(points) + len(misses) - hit - missed, steps, met, changed)

    def blank(self) -> VoxelMap:
        """An empty map of the same kind, which shares the scratch of insertion."""
        other = copy(self)
        other.blocks = BlockStore(marking=self.blocks.marking)
        other.memory = _memory(other)
        return other

    def swap(self, other: VoxelMap) -> None:
        """Become what `other`, made by `blank`, is, and the other way round."""
        self.blocks, other.blocks = other.blocks, self.blocks
        self.memory, other.memory = other.memory, self.memory

    def let_go(self, blocks: int) -> bool:
        """Drop about that many blocks of a map that is not used any more; False: there is nothing left."""
        return self.memory.let_go(blocks) or self.blocks.let_go(blocks)

    def query(self, points_odom: Array) -> Array32:
        """Log-odds (N,) of being occupied at points (N, 3), m; NaN: unknown."""
        steps = self._at(points_odom)
        return np.where(steps == UNKNOWN, np.nan, steps / self.steps.per_unit).astype(np.float32)

    def classify(self, points_odom: Array) -> NDArray[np.uint8]:
        """0 unknown, 1 free, 2 occupied (N,) at points (N, 3), m; what is not finite is unknown."""
        steps = self._at(points_odom)
        known = np.where(steps >= 0, OCCUPIED_CELL, FREE_CELL)
        return np.where(steps == UNKNOWN, UNKNOWN_CELL, known).astype(np.uint8)

    def occupied_centers(self) -> Array:
        """Centres (K, 3) of all occupied voxels, m, region by region."""
        return np.concatenate([_NO_POINTS, *(self._occupied(part) for part in self.memory.parts())])

    def window(self, block_corner: NDArray[np.int64], states: NDArray[np.uint8]) -> None:
        """Fill `states` (8a, 8b, 8c) with 0 unknown, 1 free, 2 occupied from a block corner on."""
        self.memory.bring_back((block_corner, block_corner + np.array(states.shape) // BLOCK))
        self.blocks.window(block_corner, states)

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Copies of everything that makes the map, ready for `numpy.savez`; the same map gives the same arrays."""
        parts = [(part["xyz"], part["log_odds"]) for part in self.memory.parts()]
        model = self.config.sensor
        return {
            "resolution_m": np.array(self.resolution_m),
            "sensor_model": np.array([model.hit, model.miss, model.lowest, model.highest]),
            "block_xyz": np.concatenate([np.empty((0, 3), np.int32), *(xyz for xyz, _ in parts)]),
            "log_odds": np.concatenate([np.empty((0, CELLS), np.int8), *(values for _, values in parts)]),
        }

    @classmethod
    def from_arrays(
        cls, arrays: Mapping[str, Any], config: VoxelMapConfig, *, decays: bool = False, shelf: Shelf | None = None
    ) -> VoxelMap:
        """A map from `to_arrays`; InputError when it does not fit `config` or is damaged."""
        model = config.sensor
        _check_same(arrays, "resolution_m", np.array(config.resolution_m))
        _check_same(arrays, "sensor_model", np.array([model.hit, model.miss, model.lowest, model.highest]))
        xyz, log_odds = (np.asarray(_entry(arrays, name)) for name in ("block_xyz", "log_odds"))
        if xyz.shape != (len(xyz), 3) or log_odds.shape != (len(xyz), CELLS) or log_odds.dtype != np.int8:
            raise InputError(f"shapes {xyz.shape}, {log_odds.shape} {log_odds.dtype} are no map", field="log_odds")
        if len(np.unique(xyz, axis=0)) != len(xyz):
            raise InputError("a block is there twice", field="block_xyz")
        voxels = cls(config, decays=decays, shelf=shelf)
        voxels.blocks.add(xyz, log_odds, voxels.steps.lowest, held=True)
        return voxels

    def _cast(
        self, returns: tuple[Array32, float], misses: Array32, pose: tuple[Array, Array, Array]
    ) -> tuple[int, int, int]:
        """(points, beams without return that count, voxel steps); `returns` = (points, own radius)."""
        (points, near_m), (R, offset, origin) = returns, pose
        to_points, far_m = self._rays.grid.to_grid(R, offset, origin), self.config.max_range_m
        along = (misses, self._rays.grid.to_grid(R, np.zeros(3), origin), (0.0, self.config.miss_clear_range_m, True))
        if self.config.ray_per == "point":
            (hit, missed), steps = self._rays.cast([(points, to_points, (near_m, far_m, False)), along])
            return hit, missed, steps
        start = to_points[2]
        centers, hit = end_voxels(points, to_points, near_m)
        (_, missed), steps = self._rays.cast([(centers, (np.eye(3), -start, start), (0.0, far_m, False)), along])
        return hit, missed, steps

    def _at(self, points_odom: Array) -> NDArray[np.int8]:
        points = np.asarray(points_odom, np.float64).reshape(-1, 3)
        good = np.all(np.abs(points) < 10 * _FARTHEST_M, axis=1)
        cells = np.floor(np.where(good[:, None], points, 0.0) / self.resolution_m).astype(np.int64)
        found = self.blocks.at(cells)
        self.memory.at(cells, found)
        return np.where(good, found, np.int8(UNKNOWN))

    def _occupied(self, part: Blocks) -> Array:
        row, cell = np.nonzero(part["log_odds"] >= 0)
        inside = np.stack([cell >> 6, (cell >> 3) & 7, cell & 7], axis=1)
        return np.asarray((BLOCK * part["xyz"][row] + inside + 0.5) * self.resolution_m)


def _memory(voxels: VoxelMap) -> Memory:
    """What puts blocks of the map away."""
    config = voxels.config
    return Memory(
        config.memory,
        voxels.blocks,
        resolution_m=config.resolution_m,
        lowest=voxels.steps.lowest,
        shelf=voxels.shelf,
    )


def _rows(vectors: Array32) -> Array32:
    """(N, 3), contiguous; a copy if it is read-only or not aligned, which would be one more type to compile for."""
    array = np.require(vectors, np.float32, ["C", "W", "A"])
    if array.ndim != 2 or array.shape[1] != 3:
        raise InputError(f"shape {array.shape} is no list of vectors", field="points", valid="(N, 3)")
    return array


def _check_pose(**parts: Array) -> None:
    for name, part in parts.items():
        if not all(abs(number) < _FARTHEST_M for number in part.ravel().tolist()):
            raise InputError(f"{part.tolist()} is no pose", field=name, valid=f"finite, within {_FARTHEST_M:g} m")


def _entry(arrays: Mapping[str, Any], name: str) -> Any:
    if name not in arrays:
        raise InputError("missing in the stored map", field=name)
    return arrays[name]


def _check_same(arrays: Mapping[str, Any], name: str, wanted: Array) -> None:
    stored = np.asarray(_entry(arrays, name))
    if stored.shape != wanted.shape or not np.array_equal(stored, wanted):
        raise InputError(
            f"the stored map has {stored.tolist()}",
            field=f"mapping.voxels.{name}",
            valid=str(wanted.tolist()),
        )
