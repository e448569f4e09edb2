"""Frontiers: known-free voxels beside an unknown one, kept per block and brought up to date where the map changed.

B. Yamauchi, "A frontier-based approach for autonomous exploration", 1997, in three dimensions.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from companion.core.messages import Array
from companion.mapping.block_hash import EMPTY, slot_of
from companion.mapping.deltas import in_order, keys_of
from companion.mapping.rays import BLOCK, CELLS, WORDS
from companion.mapping.voxel_map import VoxelMap

u8, u64 = np.uint8, np.uint64
_NEIGHBOURS = np.array([[0, 0, 0], [-1, 0, 0], [1, 0, 0], [0, -1, 0], [0, 1, 0], [0, 0, -1], [0, 0, 1]])
_SIZE = CELLS // 8
_NONE = bytes(_SIZE)
_LOW_FACE, _HIGH_FACE = 0x0101010101010101, 0x8080808080808080  # of a plane x, bit 8 y + z: z = 0, z = 7


class Frontiers:
    """The frontier of a map; `update` costs what changed since the last one, with the blocks beside it.

    >>> frontiers = Frontiers()
    >>> frontiers.update(voxels)
    >>> frontiers.centers(voxels.resolution_m)  # (N, 3), m

    Neighbours are those across a face. What changed, or is beside, comes back from cold memory.
    """

    def __init__(self) -> None:
        self.version = -1  # of the map, up to which it holds
        self._bits: dict[tuple[int, ...], bytes] = {}  # of blocks that have any

    def update(self, voxels: VoxelMap) -> NDArray[np.int32]:
        """Take in what changed; returns the blocks (K, 3) whose frontier is now another, in order."""
        changed = voxels.changed_since(self.version).astype(np.int64)
        self.version = voxels.version
        near = (changed[:, None] + _NEIGHBOURS).reshape(-1, 3).astype(np.int32)
        _, first = np.unique(keys_of(near), return_index=True)
        near = near[first]
        if len(near):
            voxels.memory.bring_back((near.min(axis=0) - np.int64(1), near.max(axis=0) + np.int64(2)))
        bits = np.empty((len(near), WORDS), np.uint64)
        _frontier_bits(near, voxels.blocks.table, voxels.blocks.log_odds, bits)
        raw = bits.tobytes()
        new = [raw[n : n + _SIZE] for n in range(0, len(raw), _SIZE)]
        differ = [self._replace(xyz, now) for xyz, now in zip(map(tuple, near.tolist()), new, strict=True)]
        now_other: NDArray[np.int32] = near[np.array(differ, np.bool_)]
        return now_other

    def cells(self, block_xyz: NDArray[np.int32] | None = None) -> NDArray[np.int64]:
        """Voxels (N, 3) of the frontier, of all blocks or of those at `block_xyz` (K, 3); sorted by block and cell."""
        if block_xyz is None:
            block_xyz = np.array(list(self._bits), np.int32).reshape(-1, 3)
        ordered = in_order(block_xyz)
        ordered = ordered[[tuple(xyz) in self._bits for xyz in ordered.tolist()]]
        if len(ordered) == 0:
            return np.empty((0, 3), np.int64)
        raw = b"".join(self._bits[tuple(xyz)] for xyz in ordered.tolist())
        row, cell = np.divmod(np.flatnonzero(np.unpackbits(np.frombuffer(raw, np.uint8), bitorder="little")), CELLS)
        inside = np.stack([cell >> 6, cell >> 3 & 7, cell & 7], axis=1)
        return BLOCK * ordered[row].astype(np.int64) + inside

    def centers(self, resolution_m: float, block_xyz: NDArray[np.int32] | None = None) -> Array:
        """The same as centres, m, in odom (N, 3)."""
        return np.asarray((self.cells(block_xyz) + 0.5) * resolution_m)

    def __len__(self) -> int:
        return sum(int.from_bytes(bits).bit_count() for bits in self._bits.values())

    def _replace(self, xyz: tuple[int, ...], new: bytes) -> bool:
        """Whether the block's bits were others before."""
        if new == _NONE:
            return self._bits.pop(xyz, None) is not None
        if self._bits.get(xyz) == new:
            return False
        self._bits[xyz] = new
        return True


@njit(cache=True, nogil=True)
def _frontier_bits(xyz, table, log_odds, found):  # type: ignore[no-untyped-def]
    """Bit 8 y + z of word x of each block at `xyz`: a free cell with an unknown one across a face."""
    unknown = np.empty((7, WORDS), np.uint64)
    free, spare = np.empty(WORDS, np.uint64), np.empty(WORDS, np.uint64)
    for n in range(xyz.shape[0]):
        x, y, z = np.int64(xyz[n, 0]), np.int64(xyz[n, 1]), np.int64(xyz[n, 2])
        if not _masks(table, log_odds, (x, y, z), unknown[0], free):
            found[n] = u64(0)
            continue
        _masks(table, log_odds, (x - 1, y, z), unknown[1], spare)
        _masks(table, log_odds, (x + 1, y, z), unknown[2], spare)
        _masks(table, log_odds, (x, y - 1, z), unknown[3], spare)
        _masks(table, log_odds, (x, y + 1, z), unknown[4], spare)
        _masks(table, log_odds, (x, y, z - 1), unknown[5], spare)
        _masks(table, log_odds, (x, y, z + 1), unknown[6], spare)
        for w in range(WORDS):
            here = unknown[0, w]
            beside = unknown[1, 7] if w == 0 else unknown[0, w - 1]
            beside |= unknown[2, 0] if w == 7 else unknown[0, w + 1]
            beside |= (here << u64(8)) | (unknown[3, w] >> u64(56))
            beside |= (here >> u64(8)) | (unknown[4, w] << u64(56))
            beside |= ((here << u64(1)) & ~u64(_LOW_FACE)) | ((unknown[5, w] >> u64(7)) & u64(_LOW_FACE))
            beside |= ((here >> u64(1)) & ~u64(_HIGH_FACE)) | ((unknown[6, w] << u64(7)) & u64(_HIGH_FACE))
            found[n, w] = free[w] & beside


@njit(cache=True, nogil=True)
def _masks(table, log_odds, xyz, unknown, free):  # type: ignore[no-untyped-def]
    """Bits of the unknown and of the free cells of a block; returns whether it is there."""
    keys, values = table
    slot = slot_of(keys, xyz[0], xyz[1], xyz[2])
    if keys[slot] == EMPTY:
        unknown[:], free[:] = ~u64(0), u64(0)
        return False
    words = log_odds[values[slot]].view(np.uint64)
    unknown_bytes, free_bytes = unknown.view(np.uint8), free.view(np.uint8)
    each, low = u64(0x0101010101010101), u64(0x7F7F7F7F7F7F7F7F)
    gather = u64(0x0102040810204080)
    for w in range(words.size):
        x = words[w]
        negative = (x >> u64(7)) & each
        more = (((x & low) + low) >> u64(7)) & each  # something beside the sign
        unknown_bytes[w] = u8(((negative & ~more) * gather) >> u64(56))
        free_bytes[w] = u8(((negative & more) * gather) >> u64(56))
    return True
