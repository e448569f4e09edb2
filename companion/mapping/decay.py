"""Evidence of what has left: it goes within two seconds, while thin branches and trunks stay.

A log-odds map forgets a walker as slowly as a branch that most scans see through, and never
where no ray comes by again. Two things tell them apart. A walker fills cells that the map had
seen through so often that they were at the lower clamp: such a cell is a *newcomer*. And a
branch that no ray met for a while is hit again: such a cell is *proven*, and left alone.

Every `period_s` a pass looks at the occupied cells that no ray has hit for three periods. Where
`crowd` of them in one block of 8^3 are newcomers, or a quarter of that beside such a block, these become
unknown, whether or not rays come by: one look makes them free. Where rays have passed through `crowd`
others, the evidence for these is cut to even odds, so that the next look decides. Nothing else
decays: a branch loses a cell or two at a time, what walks leaves many.

Where a track of something that moves has just been (`companion.mapping.walked`) no crowd is needed,
and nothing becomes proven: a slow walker is hit twice in the same cell. If that track is elsewhere by
now, newcomers become again what they were before it came: free.

Of what is proven, rays that pass through count in every fourth scan only (`MISSES_COUNT_EVERY`): a twig
that a few scans in a hundred hit stays, and what was proven and leaves anyway stays for up to 12 s.

A cell that was forgotten and is hit again comes from unknown, so it is no newcomer: evidence of
something that stays is lost once at most. In a loaded map only newcomers go, and back to free.
"""

from __future__ import annotations

from typing import Annotated

import msgspec
import numpy as np
from numba import njit
from numpy.typing import NDArray

from companion.core.errors import InputError
from companion.core.messages import Array, ObstacleTracks
from companion.mapping.blocks import BlockStore
from companion.mapping.marks import CAME, FRESH, MISSED, PROVEN, QUIET, STILL
from companion.mapping.rays import CELLS, WORDS
from companion.mapping.sensor_model import UNKNOWN
from companion.mapping.voxel_map import VoxelMap
from companion.mapping.walked import NOBODY, Walked, walked_cells

u64 = np.uint64
_PART = 4  # so much smaller is what of a crowd may stand in the next block
_AROUND = np.array([[x, y, z] for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1)], np.int64)


class DecayConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """How fast what has left goes."""

    on: bool = True
    period_s: Annotated[float, msgspec.Meta(ge=0.1, le=10.0)] = 0.4  # between passes; three without a hit are stale
    crowd: Annotated[int, msgspec.Meta(ge=1, le=512)] = 16  # stale cells in a block below which none decays
    forget_unseen_s: Annotated[float, msgspec.Meta(ge=0.0)] = 0.0  # blocks no ray met for so long go; 0: they stay
    walked_s: Annotated[float, msgspec.Meta(ge=0.0, le=10.0)] = 3.0  # for so long a place is one where something moved
    erase_loaded: bool = False  # whether a loaded map decays like any other


class Decay:
    """Makes the passes over a map when they are due.

    >>> decay = Decay(DecayConfig())
    >>> voxels.insert(points, ..., stamp_ns=stamp_ns)
    >>> decay.after_scan(voxels, stamp_ns)
    """

    def __init__(self, config: DecayConfig) -> None:
        self.config = config
        self._walked = Walked(config.walked_s)
        self._passed_ns: int | None = None

    def take(self, tracks: ObstacleTracks) -> None:
        """Note where things that move are."""
        self._walked.take(tracks)

    def after_scan(self, voxels: VoxelMap, stamp_ns: int) -> NDArray[np.int32]:
        """A pass if one is due; positions (K, 3) of the blocks in which a cell changed its class."""
        period_ns = round(1e9 * self.config.period_s)
        since_ns = stamp_ns - period_ns if self._passed_ns is None else self._passed_ns
        if not self.config.on or stamp_ns - since_ns < period_ns:
            return np.empty((0, 3), np.int32)
        self._passed_ns = stamp_ns
        cylinders = self._walked.cylinders(stamp_ns, voxels.resolution_m)
        return decay(voxels, stamp_ns, self.config, since_ns=since_ns, cylinders=cylinders)


def decay(
    voxels: VoxelMap, now_ns: int, config: DecayConfig, *, since_ns: int, cylinders: tuple[Array, Array] = NOBODY
) -> NDArray[np.int32]:
    """One pass at `now_ns`; the last one was at `since_ns`; `cylinders` (K, 5), (L, 5) say where something moved,
    and where something may still be.

    Returns the positions (K, 3) of the blocks in which a cell changed its class. Raises InputError
    when the map was not made for it.
    """
    blocks = voxels.blocks
    if not blocks.marking:
        raise InputError("it keeps no marks", field="voxels", valid="VoxelMap(config, decays=True)")
    rows = np.flatnonzero(blocks.stirred[: blocks.count])
    changed = np.zeros(len(rows), np.bool_)
    kept = blocks.held if not config.erase_loaded else np.zeros_like(blocks.held)
    newcomers = np.zeros(len(rows), np.int64)
    walked, occupied = (walked_cells(blocks.xyz[rows], part) for part in cylinders)
    left = walked & ~occupied
    _count_newcomers(rows, blocks.marks, blocks.log_odds, walked, newcomers)
    crowded = _crowded(blocks, rows, newcomers, config.crowd)
    _pass(rows, blocks.marks, (blocks.log_odds, kept), (config.crowd, crowded, walked, left), changed)
    rows = rows[changed]
    if config.forget_unseen_s > 0.0:
        rows = np.concatenate([rows, _forget_unseen(voxels, now_ns, since_ns, config)])
    return blocks.xyz[blocks.mark_changed(rows)] if len(rows) else np.empty((0, 3), np.int32)


def _forget_unseen(voxels: VoxelMap, now_ns: int, since_ns: int, config: DecayConfig) -> NDArray[np.int64]:
    """Make blocks unknown, cold or not, that have become old since the last pass; their rows."""
    blocks, age_ns = voxels.blocks, round(1e9 * config.forget_unseen_s)
    voxels.memory.bring_back_seen(since_ns - age_ns + 1, now_ns - age_ns)
    seen_ns = blocks.seen_ns[: blocks.count]
    old = (seen_ns <= now_ns - age_ns) & (seen_ns > since_ns - age_ns)
    if not config.erase_loaded:
        old &= blocks.held[: blocks.count] == 0
    rows = np.flatnonzero(old)
    blocks.write(rows, np.full((len(rows), CELLS), UNKNOWN, np.int8), voxels.steps.lowest)
    return rows


def _crowded(
    blocks: BlockStore, rows: NDArray[np.int64], newcomers: NDArray[np.int64], crowd: int
) -> NDArray[np.bool_]:
    """Whether (N,) a block holds a crowd of newcomers, or a part of one that stands in a block next to it."""
    crowded = newcomers >= crowd
    parts = np.flatnonzero(~crowded & (newcomers >= max(crowd // _PART, 1)))
    around = blocks.xyz[rows[parts], None, :].astype(np.int64) + _AROUND
    of_row = np.zeros(blocks.count + 1, np.bool_)  # the last, which row -1 means, stays False
    of_row[rows[crowded]] = True
    beside = of_row[blocks.rows_of(around.reshape(-1, 3))].reshape(len(parts), len(_AROUND))
    crowded[parts] = beside.any(axis=1)
    return crowded


@njit(cache=True, nogil=True)
def _count_newcomers(rows, marked, log_odds, walked, newcomers):  # type: ignore[no-untyped-def]
    _, slots, _, (bits, _, _) = marked
    gone, weak = np.empty(WORDS, np.uint64), np.empty(WORDS, np.uint64)
    for n in range(rows.size):
        slot = slots[rows[n]]
        octets = log_odds[rows[n]].view(np.uint64)
        for w in range(WORDS if slot != 0 else 0):
            newcomers[n] += _judge(bits[slot], w, _occupied(octets, w), walked[n, w], (gone, weak))


@njit(cache=True, nogil=True)
def _pass(rows, marked, cells, crowds, changed):  # type: ignore[no-untyped-def]
    (_, slots, stirred, (bits, free, left)), (log_odds, held) = marked, cells
    crowd, crowded, walked, was_left = crowds
    gone, weak, occupied = np.empty(WORDS, np.uint64), np.empty(WORDS, np.uint64), np.empty(WORDS, np.uint64)
    for n in range(rows.size):
        stirred[rows[n]] -= 1
        slot = slots[rows[n]]
        if slot == 0:
            continue
        marks, levels, keep = bits[slot], log_odds[rows[n]], held[rows[n]] != 0
        octets = levels.view(np.uint64)
        passed = 0
        for w in range(WORDS):
            occupied[w] = _occupied(octets, w)
            _judge(marks, w, occupied[w], walked[n, w], (gone, weak))
            passed += _count(weak[w])
        left_over = u64(0)
        for w in range(WORDS):
            if not crowded[n]:
                gone[w] &= walked[n, w]
            if keep:
                weak[w] = u64(0)
            elif passed < crowd:
                weak[w] &= walked[n, w]
            if gone[w] | weak[w] != u64(0):
                _lower(levels, 64 * w, (gone[w], weak[w]), ~u64(0) if keep else was_left[n, w])
                changed[n] |= gone[w] != u64(0)
            _turn(marks, w, occupied[w] & ~gone[w])
            left_over |= occupied[w] & ~gone[w]
        if left_over == u64(0):  # so there are no marks
            free[left[0]] = slot
            left[0] += 1
            slots[rows[n]] = 0


@njit(cache=True, nogil=True)
def _judge(marks, w, occupied, walked, found):  # type: ignore[no-untyped-def]
    """Newcomers among 64 cells, their number; the stale ones of them, and other stale ones that rays passed."""
    gone, weak = found
    marks[PROVEN, w] |= marks[STILL, w] & marks[FRESH, w] & ~walked
    open_ = occupied & ~marks[PROVEN, w]
    stale = open_ & marks[STILL, w] & ~marks[FRESH, w]
    gone[w] = stale & marks[CAME, w]
    weak[w] = stale & marks[MISSED, w]
    return _count(open_ & marks[CAME, w])


@njit(cache=True, nogil=True)
def _turn(marks, w, occupied):  # type: ignore[no-untyped-def]
    """The marks of 64 cells as the next period begins; a cell that is not occupied has none."""
    quiet = occupied & ~marks[FRESH, w]
    marks[STILL, w] = quiet & marks[QUIET, w]
    marks[QUIET, w] = quiet
    marks[CAME, w] &= occupied & ~marks[PROVEN, w]
    marks[PROVEN, w] &= occupied
    marks[FRESH, w] = marks[MISSED, w] = u64(0)


@njit(cache=True, nogil=True)
def _count(bits):  # type: ignore[no-untyped-def]
    """How many bits of a word are set: sums in fields of 2, 4 and 8 bits, then all by one product."""
    pairs = bits - ((bits >> u64(1)) & u64(0x5555555555555555))
    fours = (pairs & u64(0x3333333333333333)) + ((pairs >> u64(2)) & u64(0x3333333333333333))
    eights = (fours + (fours >> u64(4))) & u64(0x0F0F0F0F0F0F0F0F)
    return np.int64((eights * u64(0x0101010101010101)) >> u64(56))


@njit(cache=True, nogil=True)
def _occupied(octets, w):  # type: ignore[no-untyped-def]
    """Bits of the 64 cells from octet 8 w on whose sign is not negative."""
    bits = u64(0)
    for k in range(8):
        signs = (~octets[8 * w + k] >> u64(7)) & u64(0x0101010101010101)
        bits |= ((signs * u64(0x0102040810204080)) >> u64(56)) << u64(8 * k)
    return bits


@njit(cache=True, nogil=True)
def _lower(levels, first, bits, free):  # type: ignore[no-untyped-def]
    """Forget the cells of `gone` (those of `free` are free again); bring those of `weak` down to even odds."""
    gone, weak = bits
    for c in range(64):
        one = u64(1) << u64(c)
        if gone & one != u64(0):
            levels[first + c] = -1 if free & one != u64(0) else UNKNOWN
        elif weak & one != u64(0):
            levels[first + c] = 0
