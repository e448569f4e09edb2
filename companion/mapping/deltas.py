"""The map as bytes for others: blocks that changed since a version, or all, with 2 bits per voxel.

A record per block, all of them in one LZ4 frame: `MapDelta.msg` has the layout. A delta holds
states, not differences, so applying one twice, or one that begins too early, does no harm.
"""

from __future__ import annotations

import lz4.frame
import numpy as np
from numba import njit
from numpy.typing import NDArray

from companion.core.errors import InputError
from companion.core.messages import MapDelta
from companion.mapping.cold_region import in_region_order
from companion.mapping.rays import CELLS
from companion.mapping.voxel_map import VoxelMap

RECORD = np.dtype([("xyz", "<i4", 3), ("states", "u1", CELLS // 4)])
_FRAME = {"content_checksum": True, "store_size": False}  # 0.2 us, 36 bytes per block; zlib's 31 bytes take 1 us
_AGAIN, _AT_ONCE = 6, 4096  # how often what changed during a walk is walked through; blocks that its end may add
_MOST_BLOCKS = 1 << 22  # 0.6 GB of records: no message is larger
_HALF_RANGE = 1 << 20  # of block numbers, as in the hash
u16, u64 = np.uint16, np.uint64
Records = np.ndarray  # (N,) of RECORD


def records_of(voxels: VoxelMap, block_xyz: NDArray[np.int32]) -> Records:
    """One record (N,) per block at `block_xyz` (N, 3); of one that the map does not have, unknown voxels."""
    records = np.zeros(len(block_xyz), RECORD)
    records["xyz"] = block_xyz
    halves = records.view(np.uint16).reshape(len(records), RECORD.itemsize // 2)
    log_odds = voxels.memory.log_odds_of(block_xyz.astype(np.int64))
    _pack(log_odds.view(np.uint64), halves[:, RECORD["xyz"].itemsize // 2 :])
    return records


def states_of(records: Records) -> NDArray[np.uint8]:
    """States (N, 512) of records: 0 unknown, 1 free, 2 occupied."""
    states = records["states"][:, :, None] >> np.array([0, 2, 4, 6], np.uint8) & 3
    return np.asarray(states, np.uint8).reshape(len(records), CELLS)


def in_order(block_xyz: NDArray[np.int32]) -> NDArray[np.int32]:
    """Sorted by x, then y, then z."""
    ordered: NDArray[np.int32] = block_xyz[np.argsort(keys_of(block_xyz))]
    return ordered


def keys_of(block_xyz: NDArray[np.int32]) -> NDArray[np.int64]:
    """One number (N,) per position (N, 3), growing with x, then y, then z."""
    x, y, z = (block_xyz.astype(np.int64) + _HALF_RANGE).T
    keys: NDArray[np.int64] = x << 42 | y << 21 | z
    return keys


def delta_since(
    voxels: VoxelMap, version: int, *, stamp_ns: int, map_ns: int, most: int = _MOST_BLOCKS
) -> MapDelta | None:
    """What changed after `version` as a message; None: nothing. `map_ns` is the stamp of the map's first scan.

    Of more than `most` blocks, those that changed first, up to the `version_to` of the message; blocks of
    one version stay together.
    """
    changed, versions = voxels.changes_since(version)
    if len(changed) == 0:
        return None
    version_to = voxels.version
    if len(changed) > most:
        version_to = int(np.partition(versions, most - 1)[most - 1])
        changed = changed[versions <= version_to]
    changed = in_order(changed)
    return MapDelta(
        stamp_ns=stamp_ns,
        map_ns=map_ns,
        version_from=version,
        version_to=version_to,
        resolution_m=voxels.resolution_m,
        block_count=len(changed),
        data=lz4.frame.compress(records_of(voxels, changed).tobytes(), **_FRAME),
    )


class FullWalk:
    """The whole map as one message, made in bounded steps while the map changes.

    >>> walk = FullWalk(voxels, map_ns=0)
    >>> while (full := walk.advance(voxels, blocks=250, stamp_ns=now_ns)) is None: ...

    What was packed early may change before the end: what has changed meanwhile is packed again, a few
    times if that is much; the last step adds what changed since the last time, so that the message
    tells the map of its own `version_to`.
    """

    def __init__(self, voxels: VoxelMap, *, map_ns: int) -> None:
        self._map_ns = map_ns
        self._begun, self._again = voxels.version, _AGAIN
        self._left = in_region_order(voxels.changed_since(-1))  # so that each cold region is unpacked once or twice
        self._stream = lz4.frame.LZ4FrameCompressor(content_checksum=True)
        self._parts: list[bytes] = [self._stream.begin()]
        self._count = 0

    def advance(self, voxels: VoxelMap, *, blocks: int, stamp_ns: int) -> MapDelta | None:
        """Pack the next `blocks` blocks; the message when those were the last."""
        self._add(voxels, self._left[:blocks])
        self._left = self._left[blocks:]
        if len(self._left):
            return None
        changed = voxels.changed_since(self._begun)
        if len(changed) > _AT_ONCE and self._again > 0:
            self._begun, self._left, self._again = voxels.version, in_region_order(changed), self._again - 1
            return None
        self._add(voxels, in_order(changed))
        self._parts.append(self._stream.flush())
        return MapDelta(
            stamp_ns=stamp_ns,
            map_ns=self._map_ns,
            version_from=0,
            version_to=voxels.version,
            resolution_m=voxels.resolution_m,
            block_count=self._count,
            data=b"".join(self._parts),
        )

    def _add(self, voxels: VoxelMap, block_xyz: NDArray[np.int32]) -> None:
        self._parts.append(self._stream.compress(records_of(voxels, block_xyz).tobytes()))
        self._count += len(block_xyz)


def unpack(delta: MapDelta) -> Records:
    """The records (N,) of a message, of each block the newest; InputError if it is damaged."""
    count = delta.block_count
    if not 0 <= count <= _MOST_BLOCKS:
        raise InputError(f"{count} blocks", field="block_count", valid=f"0 to {_MOST_BLOCKS}")
    wanted = count * RECORD.itemsize
    stream = lz4.frame.LZ4FrameDecompressor()
    try:
        data = stream.decompress(delta.data, wanted + 1)
    except (RuntimeError, ValueError) as error:
        raise InputError(f"no LZ4 frame: {error}", field="data") from None
    if len(data) != wanted or not stream.eof:
        raise InputError(f"not the {wanted} bytes of {count} blocks", field="data")
    records = np.frombuffer(data, RECORD)
    if np.any(records["states"] & records["states"] >> 1 & 0x55):
        raise InputError("a voxel is in state 3", field="data", valid="0, 1, 2")
    if np.any(np.abs(records["xyz"].astype(np.int64)) >= _HALF_RANGE):
        raise InputError("a block is beyond the map's range", field="data", valid=f"+-{_HALF_RANGE}")
    _, last = np.unique(keys_of(records["xyz"])[::-1], return_index=True)
    return records[count - 1 - last]


@njit(cache=True, nogil=True)
def _pack(log_odds, halves):  # type: ignore[no-untyped-def]
    """Eight cells of a word become 16 bits of the block's record."""
    each, low = u64(0x0101010101010101), u64(0x7F7F7F7F7F7F7F7F)
    for n in range(log_odds.shape[0]):
        words = log_odds[n]
        for w in range(words.size):
            x = words[w]
            negative = (x >> u64(7)) & each
            free = negative & (((x & low) + low) >> u64(7))  # unknown is -128: nothing beside the sign
            y = free | ((negative ^ each) << u64(1))
            y = (y | (y >> u64(6))) & u64(0x000F000F000F000F)
            y = (y | (y >> u64(12))) & u64(0x000000FF000000FF)
            halves[n, w] = u16(y | (y >> u64(24)))
