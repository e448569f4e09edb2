"""Z-order: the position of a cell or block as one number, three bits per level of an octree.

Child number x + 2y + 4z of each level, as in OctoMap. Source: G. M. Morton, 1966.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

_SPREADS = (  # shift, and the bits that stay: 21 bits to every third
    (32, 0x1F00000000FFFF),
    (16, 0x1F0000FF0000FF),
    (8, 0x100F00F00F00F00F),
    (4, 0x10C30C30C30C30C3),
    (2, 0x1249249249249249),
)


def interleave(xyz: NDArray[np.int64]) -> NDArray[np.int64]:
    """Codes (N,) of positions (N, 3), each coordinate within 0 .. 2^21 - 1."""
    code = np.zeros(len(xyz), np.int64)
    for axis in range(3):
        bits = np.array(xyz[:, axis], np.int64)
        for shift, mask in _SPREADS:
            bits = (bits | bits << shift) & mask
        code |= bits << axis
    return code


def deinterleave(code: NDArray[np.int64]) -> NDArray[np.int64]:
    """Positions (N, 3) of codes (N,)."""
    xyz = np.empty((len(code), 3), np.int64)
    masks = [mask for _, mask in _SPREADS]
    for axis in range(3):
        bits = (code >> axis) & masks[-1]
        for (shift, _), mask in zip(_SPREADS[::-1], [*masks[-2::-1], 0x1FFFFF], strict=True):
            bits = (bits | bits >> shift) & mask
        xyz[:, axis] = bits
    return xyz


def cells_in_order() -> NDArray[np.int64]:
    """Number (512,) of the cell of a block, z fastest, at each Morton code within it."""
    x, y, z = deinterleave(np.arange(512)).T
    return np.asarray((x << 6) | (y << 3) | z)
