"""Centres of the occupied voxels as point clouds: PLY and PCD, both binary.

Sources: G. Turk, "The PLY Polygon File Format", 1994; the PCD v0.7 page of the Point Cloud Library.
"""

from __future__ import annotations

import numpy as np

from companion.mapping.formats.stored_map import StoredMap


def write_ply(stored: StoredMap) -> bytes:
    """x, y, z in m and `occupancy`, P(occupied), float32 each."""
    rows = _rows(stored)
    properties = "".join(f"property float {name}\n" for name in ("x", "y", "z", "occupancy"))
    head = (
        "ply\nformat binary_little_endian 1.0\n"
        f"comment occupied voxels of {stored.resolution_m!r} m, frame {stored.frame}\n"
        f"element vertex {len(rows)}\n{properties}end_header\n"
    )
    return head.encode() + rows.tobytes()


def write_pcd(stored: StoredMap) -> bytes:
    """x, y, z in m and `intensity`, P(occupied), float32 each."""
    rows = _rows(stored)
    head = (
        f"# .PCD v0.7 - occupied voxels of {stored.resolution_m!r} m, frame {stored.frame}\nVERSION 0.7\n"
        "FIELDS x y z intensity\nSIZE 4 4 4 4\nTYPE F F F F\nCOUNT 1 1 1 1\n"
        f"WIDTH {len(rows)}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {len(rows)}\nDATA binary\n"
    )
    return head.encode() + rows.tobytes()


def _rows(stored: StoredMap) -> np.ndarray:
    centers, probability = stored.occupied()
    return np.column_stack([centers, probability]).astype("<f4")
