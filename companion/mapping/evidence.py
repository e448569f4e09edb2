"""What one stretch of the flight adds to the map, cell by cell, and its form at rest: 4 bits per cell.

The map's log-odds before and after, with the cells that rays crossed and hit in between, tell
what the stretch saw. Added up again over all stretches, with the map's clamps, they give the map.
Where a clamp hides how much was seen, the evidence is what leads to the clamp from any belief
that the map can have held there.
"""

from __future__ import annotations

from dataclasses import dataclass

import lz4.block
import numpy as np
from numba import njit
from numpy.typing import NDArray

from companion.mapping.rays import CELLS, WORDS
from companion.mapping.sensor_model import UNKNOWN, Steps

i16, u8, u64 = np.int16, np.uint8, np.uint64
_PACKED = CELLS // 2  # bytes of a block's codes
_LEVELS = 14  # codes 1 to 14: evidence from the weakest for free to the lower clamp; 0: not seen
_LISTED = 15  # the value stands in a list
Levels = NDArray[np.int8]


def evidence(
    before: Levels, after: Levels, bits: tuple[NDArray[np.uint64], NDArray[np.uint64]], steps: Steps
) -> Levels:
    """Log-odds steps (N, 512) that the cells of N blocks got; UNKNOWN: no ray.

    `before`, `after` (N, 512) are the map's log-odds; `bits` = (crossed, hit), (N, 8) each.
    """
    found = np.empty(after.shape, np.int8)
    widest = min(steps.highest - steps.lowest, -UNKNOWN - 1)
    _evidence(before, after, bits, np.array([steps.lowest, steps.highest, widest], np.int16), found)
    return found


@dataclass(frozen=True, slots=True)
class PackedEvidence:
    """Evidence of `count` blocks, compressed."""

    count: int
    codes: bytes
    listed: bytes

    @property
    def memory_bytes(self) -> int:
        """Bytes of memory, estimated."""
        return len(self.codes) + len(self.listed) + 150


def pack(values: Levels, steps: Steps) -> PackedEvidence:
    """Compress evidence (N, 512); without loss if the lower clamp is at most 14 steps down, as by default.

    With other sensor models, what lies between the lower clamp and 0 is rounded to 14 levels.
    """
    codes, listed = np.empty((len(values), _PACKED), np.uint8), np.empty(values.size, np.int8)
    count = _pack(values, _codes(steps), codes, listed)
    return PackedEvidence(len(values), _packed(codes), _packed(listed[:count]))


def unpack(packed: PackedEvidence, steps: Steps) -> Levels:
    """Evidence (N, 512)."""
    codes = np.frombuffer(bytearray(lz4.block.decompress(packed.codes)), np.uint8)
    listed = np.frombuffer(bytearray(lz4.block.decompress(packed.listed)), np.int8)
    values = np.empty((packed.count, CELLS), np.int8)
    _unpack(codes.reshape(-1, _PACKED), listed, _levels(steps), values)
    return values


def added(levels: Levels, values: Levels, clamps: tuple[int, int]) -> Levels:
    """Log-odds (N, 512) with evidence (N, 512) added; `clamps` = (lowest, highest), UNKNOWN adds nothing."""
    total = np.empty_like(levels)
    bounds = np.array([max(clamps[0], UNKNOWN + 1), min(clamps[1], -UNKNOWN - 1)], np.int16)
    _add(levels.reshape(-1), values.reshape(-1), bounds, total.reshape(-1))
    return total


def _levels(steps: Steps) -> NDArray[np.int8]:
    """Value (15,) of each code but the last; that of 0 is UNKNOWN."""
    count = min(_LEVELS, -steps.lowest)
    levels = np.rint(np.minimum(np.arange(_LEVELS + 1), count) * (steps.lowest / count)).astype(np.int8)
    levels[0] = UNKNOWN
    return levels


def _codes(steps: Steps) -> NDArray[np.uint8]:
    """Code (256,) of each value, indexed by the value as uint8."""
    levels = _levels(steps).astype(np.int64)
    codes = np.full(256, _LISTED, np.uint8)
    for value in range(steps.lowest, 0):
        codes[value % 256] = 1 + np.argmin(np.abs(levels[1:] - value))
    codes[UNKNOWN % 256] = 0
    return codes


def _packed(array: NDArray[np.generic]) -> bytes:
    data: bytes = lz4.block.compress(array.tobytes())
    return data


@njit(cache=True, nogil=True)
def _evidence(before, after, bits, clamps, found):  # type: ignore[no-untyped-def]
    crossed, struck = bits
    lowest, highest, widest = clamps[0], clamps[1], clamps[2]
    unknown = np.int8(UNKNOWN)
    for n in range(after.shape[0]):
        for w in range(WORDS):
            seen, hits = crossed[n, w] | struck[n, w], struck[n, w]
            cells = slice(64 * w, 64 * (w + 1))
            out, was, now = found[n, cells], before[n, cells], after[n, cells]
            out[:] = unknown
            for b in range(64 if seen != u64(0) else 0):
                if not (seen >> u64(b)) & u64(1) or now[b] == unknown:
                    continue
                new = i16(now[b])
                change = new if was[b] == unknown else i16(new - i16(was[b]))
                if (hits >> u64(b)) & u64(1):
                    amount = max(change, i16(highest // 2)) if new >= highest else change
                else:
                    amount = min(change, lowest) if new <= lowest else min(change, i16(-1))
                out[b] = np.int8(min(max(amount, i16(-widest)), widest))


@njit(cache=True, nogil=True)
def _add(levels, values, bounds, total):  # type: ignore[no-untyped-def]
    unknown = np.int8(UNKNOWN)
    for c in range(u64(levels.size)):
        level = i16(0) if levels[c] == unknown else i16(levels[c])
        level = i16(level + i16(values[c]))
        level = bounds[0] if level < bounds[0] else level
        level = bounds[1] if level > bounds[1] else level
        total[c] = levels[c] if values[c] == unknown else np.int8(level)


@njit(cache=True, nogil=True)
def _pack(values, table, codes, listed):  # type: ignore[no-untyped-def]
    count = 0
    for n in range(values.shape[0]):
        for k in range(_PACKED):
            low, high = table[u8(values[n, 2 * k])], table[u8(values[n, 2 * k + 1])]
            codes[n, k] = low | u8(high << u8(4))
            if low == u8(_LISTED):
                listed[count] = values[n, 2 * k]
                count += 1
            if high == u8(_LISTED):
                listed[count] = values[n, 2 * k + 1]
                count += 1
    return count


@njit(cache=True, nogil=True)
def _unpack(codes, listed, levels, values):  # type: ignore[no-untyped-def]
    taken = 0
    for n in range(codes.shape[0]):
        for k in range(_PACKED):
            low, high = codes[n, k] & u8(15), codes[n, k] >> u8(4)
            if low == u8(_LISTED):
                values[n, 2 * k] = listed[taken]
                taken += 1
            else:
                values[n, 2 * k] = levels[low]
            if high == u8(_LISTED):
                values[n, 2 * k + 1] = listed[taken]
                taken += 1
            else:
                values[n, 2 * k + 1] = levels[high]
