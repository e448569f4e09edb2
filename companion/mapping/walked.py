"""Where things that move were in the last seconds, as the map sees it: what stands there is theirs to leave."""

from __future__ import annotations

from collections import deque

import numpy as np
from numba import njit
from numpy.typing import NDArray

from companion.core.messages import Array, ObstacleTracks
from companion.mapping.rays import BLOCK, WORDS

u64 = np.uint64
_LEAST_SPEED = 0.3  # m/s: what is slower may be a branch in the wind
_FRESH_NS = 500_000_000  # what was told longer ago says nothing of now
_HALF_HEIGHT_M = 2.0  # above and below the middle of what is seen of it
_MARGIN_M = 0.3  # of a walker often one side alone is seen
_AWAY_M, _AWAY_SIGMAS = 0.2, 3.0  # beyond that, and what is known of its place: it is not there
NOBODY: tuple[Array, Array] = (np.empty((0, 5)), np.empty((0, 5)))  # no cylinders


class Walked:
    """Upright cylinders, one for each track in each message of the last seconds."""

    def __init__(self, keep_s: float) -> None:
        self._keep_ns = round(1e9 * keep_s)
        self._seen: deque[tuple[int, NDArray[np.int64], Array]] = deque()
        self._newest: ObstacleTracks | None = None

    def take(self, tracks: ObstacleTracks) -> None:
        """Note where its tracks are; those that hardly move are none."""
        self._newest = tracks
        moves = np.linalg.norm(tracks.velocity_odom, axis=1) >= _LEAST_SPEED
        if moves.any():
            seen = np.column_stack([tracks.position_odom[moves], tracks.radius_m[moves] + _MARGIN_M])
            self._seen.append((tracks.stamp_ns, tracks.id[moves], seen))

    def cylinders(self, now_ns: int, cell_m: float) -> tuple[Array, Array]:
        """Where things that move have been, and where one may still be: (K, 5), (L, 5), in cells.

        x and y, radius squared, lowest and highest z. One that is still tracked is there; of a lost one nobody knows.
        """
        if self._newest is not None and now_ns - self._newest.stamp_ns > _FRESH_NS:
            self._newest = None
        while self._seen and self._seen[0][0] < now_ns - self._keep_ns:
            self._seen.popleft()
        seen = np.concatenate([np.empty((0, 4)), *(rows for _, _, rows in self._seen)])
        ids = np.concatenate([np.empty(0, np.int64), *(ids for _, ids, _ in self._seen)])
        told = np.isin(ids, self._newest.id) if self._newest else np.zeros(len(ids), np.bool_)
        return _upright(seen, cell_m), _upright(np.concatenate([seen[~told], self._here()]), cell_m)

    def _here(self) -> Array:
        """Place and radius (N, 4) of the tracks that are told, as far as they may be from there."""
        if self._newest is None:
            return np.empty((0, 4))
        wide_m = self._newest.radius_m + _MARGIN_M + _AWAY_M + _AWAY_SIGMAS * np.sqrt(self._newest.position_variance)
        return np.column_stack([self._newest.position_odom, wide_m])


def _upright(seen: Array, cell_m: float) -> Array:
    """Cylinders (K, 5) about places and radii (K, 4), m."""
    at, reach = seen / cell_m, _HALF_HEIGHT_M / cell_m
    parts = [at[:, :2], at[:, 3] ** 2, at[:, 2] - reach, at[:, 2] + reach]
    return np.ascontiguousarray(np.column_stack(parts))  # one layout: a kernel is compiled for each


def walked_cells(block_xyz: NDArray[np.int32], cylinders: Array) -> NDArray[np.uint64]:
    """Bits (N, 8) of the cells whose middle is in a cylinder (K, 5), for blocks at (N, 3)."""
    bits = np.zeros((len(block_xyz), WORDS), np.uint64)
    _walked(block_xyz, cylinders, bits)
    return bits


@njit(cache=True, nogil=True)
def _walked(block_xyz, cylinders, bits):  # type: ignore[no-untyped-def]
    for n in range(len(block_xyz)):
        x, y, z = BLOCK * block_xyz[n, 0], BLOCK * block_xyz[n, 1], BLOCK * block_xyz[n, 2]
        for k in range(len(cylinders)):
            at_x, at_y, radius2, low, high = cylinders[k]
            beside_x = max(x - at_x, at_x - (x + BLOCK), 0.0)
            beside_y = max(y - at_y, at_y - (y + BLOCK), 0.0)
            if beside_x**2 + beside_y**2 < radius2 and low < z + BLOCK and high > z:
                _stand(bits[n], (at_x - x - 0.5, at_y - y - 0.5), radius2, (low - z - 0.5, high - z - 0.5))


@njit(cache=True, nogil=True)
def _stand(bits, middle, radius2, heights):  # type: ignore[no-untyped-def]
    """One cylinder in one block; word x holds a column of eight cells for each y."""
    column = u64(0)
    for z in range(BLOCK):
        if heights[0] <= z <= heights[1]:
            column |= u64(1) << u64(z)
    for x in range(BLOCK):
        for y in range(BLOCK):
            if (x - middle[0]) ** 2 + (y - middle[1]) ** 2 <= radius2:
                bits[x] |= column << u64(BLOCK * y)
