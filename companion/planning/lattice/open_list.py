"""The open list: buckets of a sixteenth of a cell in a ring (Dial 1969), newest first within a bucket.

`heads` (RING,) first entry of each bucket; `pool` (K, 2) node and next entry; `state` as numbered below. Nothing is
taken out when a node gets a cheaper way: the old entry comes up later and finds the node closed.
"""

from __future__ import annotations

import numpy as np
from numba import njit

RING = 512
PER_CELL = 16  # buckets
USED, FREE, SIZE, BUCKET = range(4)  # of state: entries ever used, first freed one, entries in the list, bucket now
ROOM = 32  # more than a cell has neighbours


@njit(cache=True, nogil=True)
def empty_list():  # type: ignore[no-untyped-def]
    """heads, pool, state."""
    state = np.zeros(4, np.int64)
    state[FREE] = -1
    return np.full(RING, -1, np.int32), np.empty((4096, 2), np.int32), state


@njit(cache=True, nogil=True)
def with_room(pool, state, more):  # type: ignore[no-untyped-def]
    """The pool, or a larger copy, with room for `more` nodes."""
    if state[USED] + more <= pool.shape[0]:
        return pool
    larger = np.empty((2 * pool.shape[0] + more, 2), np.int32)
    for n in range(pool.shape[0]):
        larger[n, 0], larger[n, 1] = pool[n, 0], pool[n, 1]
    return larger


@njit(cache=True, nogil=True)
def push(heads, pool, state, node, f):  # type: ignore[no-untyped-def]
    """Add a node with cost and bound `f`, in cells; not before the bucket that is looked at."""
    entry = state[FREE]
    if entry < 0:
        entry = state[USED]
        state[USED] += 1
    else:
        state[FREE] = pool[entry, 1]
    slot = max(int(f * PER_CELL), state[BUCKET]) % RING
    pool[entry, 0], pool[entry, 1] = node, heads[slot]
    heads[slot] = entry
    state[SIZE] += 1


@njit(cache=True, nogil=True)
def pop(heads, pool, state, most):  # type: ignore[no-untyped-def]
    """A node of the least bucket; -1: the list is empty or the rest have `f` of at least `most`."""
    if state[SIZE] == 0:
        return -1
    while heads[state[BUCKET] % RING] < 0:
        state[BUCKET] += 1
        if state[BUCKET] >= most * PER_CELL:
            return -1
    slot = state[BUCKET] % RING
    entry = heads[slot]
    heads[slot] = pool[entry, 1]
    pool[entry, 1] = state[FREE]
    state[FREE] = entry
    state[SIZE] -= 1
    return pool[entry, 0]
