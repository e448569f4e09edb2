"""The flight in stretches, each with what it alone adds to the map: what a correction moves.

Insertion shows each scan's bits to `Submaps.watch`, which notes per stretch which cells were
crossed and hit, and what the map held before. That costs a fraction of insertion; to keep the
scans and cast their rays again would cost 30 times as much as moving what they added up to.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass, field
from typing import Annotated

import msgspec
import numpy as np
from numba import njit
from numpy.typing import NDArray

from companion.core.messages import Array
from companion.mapping.blocks import BlockStore
from companion.mapping.cold_region import ColdRegion, keys_of, regions_of
from companion.mapping.cold_region import pack as put_by
from companion.mapping.evidence import Levels, PackedEvidence, added, evidence, pack, unpack
from companion.mapping.pose_track import PoseTrack
from companion.mapping.rays import CELLS, WORDS, ScanBits
from companion.mapping.sensor_model import Steps
from companion.mapping.shelf import Shelves
from companion.mapping.voxel_map import VoxelMap

_GROWTH = 4096  # blocks
_PART_BYTES = 300  # of the objects around a part's bytes
Evidence = tuple[NDArray[np.int32], Levels]
"""Positions (N, 3) of blocks, and what their cells (N, 512) got, log-odds steps; UNKNOWN: no ray."""


class SubmapConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """How finely a correction can bend the flight, and what the memory of it may cost."""

    length_m: Annotated[float, msgspec.Meta(gt=0.0)] = 20.0  # of way per stretch; each moves as a rigid piece
    pack_blocks_per_scan: Annotated[int, msgspec.Meta(ge=1)] = 1024  # of a stretch that has ended
    budget_mb: Annotated[float, msgspec.Meta(gt=0.0)] = 256.0  # 10^6 bytes at rest; beyond, stretches are joined


@dataclass(slots=True)
class Submap:
    """Evidence of one stretch at rest, in the frame `odom` as it was believed then."""

    anchor_ns: int  # the scan in the middle of its way: where that goes, all of it goes
    last_ns: int  # newest scan
    length_m: float
    blocks: int
    parts: list[_Part] = field(default_factory=list)

    @property
    def memory_bytes(self) -> int:
        """Bytes of memory, estimated, as if nothing lay on a shelf."""
        return sum(sum(part.sizes) + _PART_BYTES for part in self.parts)


@dataclass(frozen=True, slots=True)
class _Part:
    """Some blocks of a stretch: their positions and evidence, packed, on the shelves."""

    number: int
    sizes: tuple[int, int, int]  # bytes of the positions, codes and list
    count: int


class Submaps:
    """Submaps of the flight so far, for `companion.mapping.correction`.

    >>> submaps = Submaps(SubmapConfig(), voxels)  # after loading a map, before the first scan
    >>> voxels.insert(points, ..., stamp_ns=stamp_ns, watch=submaps.watch)
    >>> submaps.after_scan(stamp_ns, p_odom, q_odom_body)

    `closed` are at rest, in order of time, where the map has its cold blocks; `loaded` are regions of a
    loaded map as it was.
    """

    def __init__(self, config: SubmapConfig, voxels: VoxelMap) -> None:
        self.config = config
        self.voxels = voxels
        self.track = PoseTrack()  # of each scan, in `odom`
        self.closed: list[Submap] = []
        self.loaded = _loaded(voxels)
        self.joining = True  # stretches may be joined
        self.shelves = Shelves(voxels.shelf if voxels.config.memory.spill else None)
        self._closing: list[tuple[Submap, Evidence]] = []  # with the part that is not packed yet
        self._anchor_ns: int | None = None  # None: no scan yet
        self._at: Array | None = None  # where the newest scan of the open stretch was
        self._length_m = 0.0
        self._begin()

    @property
    def memory_bytes(self) -> int:
        """Bytes in memory of submaps at rest and of the stretch that is open."""
        rest = sum(submap.memory_bytes for submap in self.closed) + self.track.memory_bytes
        rest += sum(region.memory_bytes for _, region in self.loaded)
        waiting = sum(xyz.nbytes + values.nbytes for _, (xyz, values) in self._closing)
        return (
            rest
            - self.shelves.outside_bytes
            + waiting
            + self._before.memory_bytes
            + self._crossed.nbytes
            + self._hit.nbytes
        )

    @property
    def settled(self) -> bool:
        """No stretch waits to be packed."""
        return not self._closing

    @property
    def open_blocks(self) -> int:
        """Blocks of the open stretch."""
        return self._before.count

    def waits_only_for(self, submap: Submap | None) -> bool:
        """No stretch but this one waits to be packed."""
        return all(one is submap for one, _ in self._closing)

    def watch(self, met: NDArray[np.int64], rows: NDArray[np.int64], bits: ScanBits) -> None:
        """Note what a scan is about to change; the argument `watch` of `VoxelMap.insert`."""
        blocks = self.voxels.blocks
        xyz = blocks.xyz[rows]
        own = self._before.rows_of(xyz.astype(np.int64))
        new = np.flatnonzero(own < 0)
        own[new] = np.arange(self._before.count, self._before.count + len(new))
        self._before.add(xyz[new], blocks.log_odds[rows[new]], self.voxels.steps.lowest, held=False)
        if self._before.count > len(self._crossed):
            self._grow(self._before.count)
        _note(met, own, bits, (self._crossed, self._hit))

    def after_scan(self, stamp_ns: int, p_odom: Array, q_odom_body: Array) -> None:
        """A scan is in the map: its pose; then a bounded part of the packing."""
        if self._at is not None:
            self._length_m += float(np.linalg.norm(p_odom - self._at))
        self._at = np.array(p_odom)
        self.track.add(stamp_ns, p_odom, q_odom_body)
        if self._anchor_ns is None or self._length_m < 0.5 * self.config.length_m:
            self._anchor_ns = stamp_ns
        if self._length_m >= self.config.length_m:
            self.close()
        self.pack_some()

    def evidence(self, submap: Submap) -> Evidence:
        """What a stretch at rest saw. Raises OSError: it cannot be read any more."""
        xyz, values = [np.empty((0, 3), np.int32)], [np.empty((0, CELLS), np.int8)]
        for part in submap.parts:
            data, (a, b, c) = self.shelves.get(part.number), part.sizes
            xyz.append(np.frombuffer(zlib.decompress(data[:a]), np.int32).reshape(-1, 3))
            packed = PackedEvidence(part.count, data[a : a + b], data[a + b : a + b + c])
            values.append(unpack(packed, self.voxels.steps))
        return np.concatenate(xyz), np.concatenate(values)

    def close(self) -> tuple[Submap, Evidence] | None:
        """End the open stretch and begin another; returns it with its evidence, not packed yet."""
        if self._anchor_ns is None:
            return None
        count, voxels = self._before.count, self.voxels
        xyz = self._before.xyz[:count].copy()
        after = voxels.memory.log_odds_of(xyz.astype(np.int64))
        bits = (self._crossed[:count], self._hit[:count])
        values = evidence(self._before.log_odds[:count], after, bits, voxels.steps)
        submap = Submap(self._anchor_ns, self.track.newest_ns, self._length_m, count)
        self._closing.append((submap, (xyz, values)))
        self._begin()
        return submap, (xyz, values)

    def _begin(self) -> None:
        self._before = BlockStore()
        self._crossed, self._hit = np.zeros((_GROWTH, WORDS), np.uint64), np.zeros((_GROWTH, WORDS), np.uint64)
        self._anchor_ns, self._at, self._length_m = None, None, 0.0

    def _grow(self, count: int) -> None:
        more = np.zeros((-(-count // _GROWTH) * _GROWTH - len(self._crossed), WORDS), np.uint64)
        self._crossed, self._hit = np.concatenate([self._crossed, more]), np.concatenate([self._hit, more])

    def pack_some(self) -> None:
        """Pack a bounded number of blocks of the oldest stretch that has ended."""
        if not self._closing:
            return
        submap, (xyz, values) = self._closing[0]
        count = self.config.pack_blocks_per_scan
        submap.parts.append(self._rest(xyz[:count], values[:count]))
        self._closing[0] = (submap, (xyz[count:], values[count:]))
        if len(values) <= count:
            self.closed.append(self._closing.pop(0)[0])
            if self.joining and sum(part.memory_bytes for part in self.closed) > 1e6 * self.config.budget_mb:
                self._join()

    def _join(self) -> None:
        """Make one of the two neighbours that are shortest together; the way bends less finely from now on."""
        if len(self.closed) < 2:
            return
        k = min(range(len(self.closed) - 1), key=lambda k: self.closed[k].length_m + self.closed[k + 1].length_m)
        a, b = self.closed[k : k + 2]
        try:
            xyz, values = _joined(self.evidence(a), self.evidence(b), self.voxels.steps)
        except OSError:  # the next correction will find that, too
            self.joining = False
            return
        longer = a if a.length_m >= b.length_m else b
        joined = Submap(longer.anchor_ns, b.last_ns, a.length_m + b.length_m, len(xyz), [self._rest(xyz, values)])
        self.closed[k : k + 2] = [joined]
        for part in (*a.parts, *b.parts):
            self.shelves.drop(part.number)

    def _rest(self, xyz: NDArray[np.int32], values: Levels) -> _Part:
        """Put blocks and their evidence by."""
        places, packed = zlib.compress(np.ascontiguousarray(xyz).tobytes(), 1), pack(values, self.voxels.steps)
        data = (places, packed.codes, packed.listed)
        sizes = (len(places), len(packed.codes), len(packed.listed))
        return _Part(self.shelves.put(b"".join(data)), sizes, len(values))


def _loaded(voxels: VoxelMap) -> list[tuple[int, ColdRegion]]:
    """Key and blocks of each region of a loaded map, without loss."""
    regions = []
    for part in voxels.memory.parts():
        chosen = part["held"] != 0
        if np.any(chosen):
            key = int(keys_of(regions_of(part["xyz"][:1]))[0])
            regions.append((key, put_by({name: array[chosen] for name, array in part.items()})))
    return regions


def _joined(a: Evidence, b: Evidence, steps: Steps) -> Evidence:
    """Both as one rigid piece."""
    both = BlockStore()
    both.add(*a, steps.lowest, held=False)
    (xyz, values), rows = b, both.rows_of(b[0].astype(np.int64))
    known = rows >= 0
    widest = steps.highest - steps.lowest
    both.write(rows[known], added(both.log_odds[rows[known]], values[known], (-widest, widest)), steps.lowest)
    both.add(xyz[~known], values[~known], steps.lowest, held=False)
    return both.xyz[: both.count].copy(), both.log_odds[: both.count].copy()


@njit(cache=True, nogil=True)
def _note(met, own, bits, noted):  # type: ignore[no-untyped-def]
    (crossed, hit), (free, hits, hit_of) = noted, bits
    for m in range(met.size):
        struck = hit_of[met[m]]
        for w in range(WORDS):
            crossed[own[m], w] |= free[met[m], w]
            if struck != 0:
                hit[own[m], w] |= hits[struck, w]
