"""Voxel keys and an open-addressing hash of bounded load, for kernels; key 0 marks a free slot."""

from __future__ import annotations

import math

import numpy as np
from numba import njit


def table_size(entries: int) -> int:
    """The power of two that keeps the load of `entries` at or below one half."""
    return 1 << max(4, math.ceil(math.log2(2 * entries)))


@njit(cache=True, nogil=True)
def pack(i, j, k):  # type: ignore[no-untyped-def]
    """Voxel indices, each in [-2**19, 2**19) (wrapping beyond), to one positive key."""
    low = np.int64(0xFFFFF)
    half = np.int64(1 << 19)
    return np.int64(1 << 60) | ((i + half) & low) | (((j + half) & low) << 20) | (((k + half) & low) << 40)


@njit(cache=True, nogil=True)
def home_of(keys, key):  # type: ignore[no-untyped-def]
    """Index at which the search for `key` begins."""
    h = np.uint64(key)
    h ^= h >> np.uint64(31)
    h *= np.uint64(0x9E3779B97F4A7C15)
    h ^= h >> np.uint64(29)
    return h & np.uint64(keys.shape[0] - 1)


@njit(cache=True, nogil=True)
def slot_of(keys, key):  # type: ignore[no-untyped-def]
    """Index of `key`, or of the free slot where it belongs. `keys` must not be full."""
    mask = np.uint64(keys.shape[0] - 1)
    s = home_of(keys, key)
    while keys[s] != key and keys[s] != 0:
        s = (s + np.uint64(1)) & mask
    return s
