"""Memory of a search by RRT*: its own tree, and the pair of RRT-Connect. See `tree` for the arrays."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from companion.core.messages import Array
from companion.planning.tree import COST, NEVER, add

OWN, FROM_START, FROM_GOAL = range(3)
PATH_POINTS = 2048


@dataclass(frozen=True, slots=True, eq=False)
class Trees:
    """Tree OWN, and from FROM_START on the pair."""

    nodes: Array
    links: NDArray[np.int32]
    heads: NDArray[np.int32]
    kept: tuple[Array, Array]  # the best path, and scratch, (PATH_POINTS, 3) each

    @classmethod
    def of(cls, nodes: int, grid: tuple[Any, ...]) -> Trees:
        """Room for so many nodes each, and buckets of a `grid`."""
        links = np.full((3, nodes, 4), -1, np.int32)
        heads = np.full((3, *grid), -1, np.int32)
        return cls(np.zeros((3, nodes, 4)), links, heads, (np.zeros((PATH_POINTS, 3)), np.zeros((PATH_POINTS, 3))))

    @property
    def pair(self) -> tuple[Array, NDArray[np.int32], NDArray[np.int32]]:
        """nodes (2, C, 4), links, heads."""
        return self.nodes[FROM_START:], self.links[FROM_START:], self.heads[FROM_START:]

    def plant(self, which: int, roots: Array, bucket: float) -> None:
        """Empty a tree and give it its roots (K, 3); only the first is found by searches."""
        _plant(self.nodes[which], self.links[which], self.heads[which], roots, bucket)


@njit(cache=True, nogil=True)
def _plant(nodes, links, head, roots, bucket):  # type: ignore[no-untyped-def]
    head[:] = -1
    for n in range(roots.shape[0]):
        for k in range(3):
            nodes[n, k] = roots[n, k]
        nodes[n, COST] = NEVER
        links[n, :] = -1
    add(nodes, links, head, 0, -1, bucket)
