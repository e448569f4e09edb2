"""Blocks as a pruned octree of 16 levels, and back, level by level on whole arrays.

A node is known by its depth (0: the root, 16: a voxel) and Morton code. Source: A. Hornung et
al., "OctoMap", Autonomous Robots, 2013; key 32768 is coordinate 0, so that its grid is ours.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from companion.core.errors import InputError
from companion.mapping.formats.morton import cells_in_order, deinterleave, interleave
from companion.mapping.rays import CELLS
from companion.mapping.sensor_model import UNKNOWN

DEPTH = 16
BLOCK_DEPTH = DEPTH - 3  # a node there spans a block
_HALF = 1 << (BLOCK_DEPTH - 1)  # block coordinate of key 0


@dataclass(frozen=True, slots=True, eq=False)
class Level:
    """All nodes (N,) of one depth, in order of their codes; siblings stand side by side."""

    value: NDArray[np.int8]  # the highest among its leaves
    child_mask: NDArray[np.uint8]  # bit c: child c is there; 0: a leaf
    child_number: NDArray[np.uint8]  # which child of its parent it is
    parent: NDArray[np.int64]  # index in the level above


def tree_of(block_xyz: NDArray[np.int32], values: NDArray[np.int8]) -> list[Level]:
    """Levels 0 to 16 of the blocks (N, 3) with `values` (N, 512); empty without blocks.

    Eight leaves of one value become one leaf. Raises InputError for what lies beyond 2^15 voxels.
    """
    if len(block_xyz) and not np.all((block_xyz >= -_HALF) & (block_xyz < _HALF)):
        raise InputError("reaches beyond OctoMap's 32768 voxels from the origin", field="extent")
    block_codes = interleave(block_xyz.astype(np.int64) + _HALF)
    order = np.argsort(block_codes)
    dense = values[order][:, cells_in_order()]
    row, cell = np.nonzero(dense != UNKNOWN)
    code = block_codes[order][row] * CELLS + cell
    value, mask = dense[row, cell], np.zeros(len(code), np.uint8)
    levels: list[Level] = []
    for _ in range(DEPTH if len(code) else 0):
        first, parent = _siblings(code >> 3)
        number = (code & 7).astype(np.uint8)
        highest, merged = _merge(value, mask, first)
        stay = ~merged[parent]
        if levels:
            levels[-1].parent[:] = (np.cumsum(stay) - 1)[levels[-1].parent]  # those that merged have no children
        levels.append(Level(value[stay], mask[stay], number[stay], parent[stay]))
        above = np.bitwise_or.reduceat(np.left_shift(1, number, dtype=np.uint8), first)
        code, value, mask = code[first] >> 3, highest, np.where(merged, 0, above).astype(np.uint8)
    if len(code):
        levels.append(Level(value, mask, np.zeros(1, np.uint8), np.zeros(1, np.int64)))
    return levels[::-1]


def _siblings(parents: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Index of the first of each run of equals, and the number of the run (N,)."""
    starts = np.concatenate([[True], parents[1:] != parents[:-1]])
    return np.flatnonzero(starts), np.cumsum(starts) - 1


def _merge(
    value: NDArray[np.int8], mask: NDArray[np.uint8], first: NDArray[np.int64]
) -> tuple[NDArray[np.int8], NDArray[np.bool_]]:
    """Highest value of each group of siblings, and whether it is eight leaves of that value."""
    highest = np.maximum.reduceat(value, first)
    same = np.minimum.reduceat(value, first) == highest
    leaves = np.maximum.reduceat(mask, first) == 0
    counts = np.diff(np.append(first, len(value)))
    return highest, same & leaves & (counts == 8)


def places(levels: list[Level], own: list[NDArray[np.int64]]) -> tuple[list[NDArray[np.int64]], int]:
    """Where each node's bytes begin when parents come before children; and the number of bytes.

    `own` are the bytes of each node itself, per level.
    """
    whole = [size.copy() for size in own]
    for depth in range(len(levels) - 1, 0, -1):
        np.add.at(whole[depth - 1], levels[depth].parent, whole[depth])
    begin = [np.zeros(1, np.int64)]
    for depth in range(1, len(levels)):
        parent = levels[depth].parent
        before = np.cumsum(whole[depth]) - whole[depth]
        if len(parent):
            first, run = _siblings(parent)
            before -= before[first][run]
        begin.append(begin[-1][parent] + own[depth - 1][parent] + before)
    return begin, int(whole[0][0])


def blocks_of(
    code: NDArray[np.int64], depth: NDArray[np.uint8], value: NDArray[np.int8], most_blocks: int
) -> tuple[NDArray[np.int32], NDArray[np.int8]]:
    """Blocks (N, 3) and log-odds (N, 512) of leaves (K,), `code` being that of their first voxel.

    Leaves above a block are expanded. Raises InputError if they are more than `most_blocks`.
    """
    coarse = depth < BLOCK_DEPTH
    counts = 8 ** (BLOCK_DEPTH - depth[coarse].astype(np.int64))
    if int(counts.sum()) > most_blocks:
        raise InputError(f"holds {int(counts.sum()):,} whole blocks of 8^3 voxels", valid=f"up to {most_blocks:,}")
    starts = np.repeat(np.cumsum(counts) - counts, counts)
    expanded = np.repeat(code[coarse] >> 9, counts) + np.arange(len(starts)) - starts
    numbers = np.unique(np.concatenate([expanded, code[~coarse] >> 9]))
    if len(numbers) > most_blocks:
        raise InputError(f"holds {len(numbers):,} blocks of 8^3 voxels", valid=f"up to {most_blocks:,}")
    cells = np.full((len(numbers), CELLS), UNKNOWN, np.int8)
    cells[np.searchsorted(numbers, expanded)] = np.repeat(value[coarse], counts)[:, None]
    flat = cells.reshape(-1)
    for level in range(BLOCK_DEPTH, DEPTH + 1):
        chosen = depth == level
        begin = np.searchsorted(numbers, code[chosen] >> 9) * CELLS + (code[chosen] & (CELLS - 1))
        flat[begin[:, None] + np.arange(8 ** (DEPTH - level))] = value[chosen][:, None]
    log_odds = np.empty_like(cells)
    log_odds[:, cells_in_order()] = cells
    return (deinterleave(numbers) - _HALF).astype(np.int32), log_odds
