"""Saves the map of a flight beside its logs."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from companion.core.node import Node
from companion.mapping.node import MappingNode


def save_map(path: Path, nodes: Sequence[Node]) -> None:
    """Write `path` (.npz; `VoxelMap.from_arrays` reads it) if the map is among the nodes."""
    for node in nodes:
        if isinstance(node, MappingNode):
            arrays: dict[str, Any] = {**node.voxels.to_arrays()}
            np.savez_compressed(path, **arrays)
