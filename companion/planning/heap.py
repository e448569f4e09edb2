"""A binary heap in flat arrays: keys (C,), items (C,), size (1,); the caller sees to the room.

Entries are not changed: an item that gets a smaller key is pushed again, and comes up first.
"""

from __future__ import annotations

from numba import njit


@njit(cache=True, nogil=True)
def push(keys, items, size, key, item):  # type: ignore[no-untyped-def]
    """Add an item."""
    n = size[0]
    size[0] = n + 1
    while n > 0:
        above = (n - 1) >> 1
        if keys[above] <= key:
            break
        keys[n], items[n] = keys[above], items[above]
        n = above
    keys[n], items[n] = key, item


@njit(cache=True, nogil=True)
def pop(keys, items, size):  # type: ignore[no-untyped-def]
    """Take the item with the least key out; there must be one."""
    first, last = items[0], size[0] - 1
    key, item, n = keys[last], items[last], 0
    size[0] = last
    while True:
        below = 2 * n + 1
        if below >= last:
            break
        if below + 1 < last and keys[below + 1] < keys[below]:
            below += 1
        if keys[below] >= key:
            break
        keys[n], items[n] = keys[below], items[below]
        n = below
    keys[n], items[n] = key, item
    return first
