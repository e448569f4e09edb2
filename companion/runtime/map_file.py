"""Reads and writes maps as files, the format by the suffix; saves the map of a flight beside its logs."""

from __future__ import annotations

import os
import zipfile
import zlib
from collections.abc import Callable, Sequence
from io import BytesIO
from pathlib import Path

import numpy as np

import companion
from companion.core.errors import InputError
from companion.core.node import Node
from companion.mapping.feature_map import FeatureMap
from companion.mapping.formats.octomap import read_octomap, write_bt, write_ot
from companion.mapping.formats.points import write_pcd, write_ply
from companion.mapping.formats.stored_map import StoredMap, stored
from companion.mapping.formats.umap import Progress, pack, unpack
from companion.mapping.landmark_node import LandmarkNode
from companion.mapping.node import MappingNode
from companion.mapping.sensor_model import SensorModel

MAP_FILE = "map.umap"  # in the folder of a flight
FEATURES = "features"  # section with the landmarks
READABLE = (".umap", ".bt", ".ot", ".npz")
_WRITERS: dict[str, Callable[[StoredMap], bytes]] = {
    ".bt": write_bt,
    ".ot": write_ot,
    ".ply": write_ply,
    ".pcd": write_pcd,
}
WRITABLE = (".umap", *_WRITERS)


def save_map(path: Path, nodes: Sequence[Node]) -> None:
    """Write `path` (.umap) if the map is among the nodes, with the landmarks if those are, too."""
    sections: dict[str, bytes] = {}
    for node in nodes:
        if isinstance(node, LandmarkNode):
            sections[FEATURES] = node.features.to_bytes()
    for node in nodes:
        if isinstance(node, MappingNode):
            created_by = f"understory {companion.__version__}"
            write_map(path, stored(node.voxels, created_by=created_by, sections=sections))


def features_of(stored_map: StoredMap) -> FeatureMap | None:
    """The landmarks in a map's file, None if it has none; InputError if they are damaged."""
    data = stored_map.sections.get(FEATURES)
    return None if data is None else FeatureMap.from_bytes(data)


def read_map(path: Path, *, sensor: SensorModel | None = None, on_progress: Progress | None = None) -> StoredMap:
    """The map of a file, in canonical form; of a folder, that of the flight in it.

    `.umap` says its sensor model itself; for `.bt` and `.ot` it is `sensor`, by default ours.
    Raises InputError that names the file and says what is wrong.
    """
    path = map_path(path)
    suffix = _suffix(path, READABLE)
    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError(error.strerror or "cannot be read", file=str(path), valid="a map file") from error
    if suffix == ".umap":
        return unpack(data, file=str(path), on_progress=on_progress)
    if suffix == ".npz":
        return _read_npz(data, str(path))
    return read_octomap(data, file=str(path), sensor=sensor)


def map_path(path: Path) -> Path:
    """The file itself, or the map in the folder of a flight."""
    if not path.is_dir():
        return path
    old = path / "map.npz"
    return old if old.exists() and not (path / MAP_FILE).exists() else path / MAP_FILE


def check_writable(path: Path) -> None:
    """Raises InputError if the suffix is none that can be written."""
    _suffix(path, WRITABLE)


def write_map(path: Path, stored_map: StoredMap, *, on_progress: Progress | None = None) -> int:
    """Write the map; returns the bytes. Raises InputError for a suffix or a place that cannot be."""
    suffix = _suffix(path, WRITABLE)
    if suffix == ".umap":
        return write_file(path, pack(stored_map, on_progress=on_progress))
    return write_file(path, _WRITERS[suffix](stored_map))


def write_file(path: Path, data: bytes) -> int:
    """Write the whole file or none of it; returns the bytes."""
    part = path.with_name(f"{path.name}.part")
    try:
        part.write_bytes(data)
        os.replace(part, path)
    except OSError as error:
        part.unlink(missing_ok=True)
        raise InputError(error.strerror or "cannot be written", file=str(path), valid="a place to write to") from error
    return len(data)


def _suffix(path: Path, valid: Sequence[str]) -> str:
    suffix = path.suffix.lower()
    if suffix not in valid:
        raise InputError(f"no map by its name: {suffix or 'no suffix'}", file=str(path), valid=", ".join(valid))
    return suffix


def _read_npz(data: bytes, file: str) -> StoredMap:
    """`map.npz` of flights before `.umap`."""
    try:
        with np.load(BytesIO(data)) as arrays:
            hit, miss, lowest, highest = (float(v) for v in arrays["sensor_model"])
            return StoredMap(
                resolution_m=float(arrays["resolution_m"]),
                sensor=SensorModel(hit=hit, miss=miss, lowest=lowest, highest=highest),
                block_xyz=arrays["block_xyz"],
                log_odds=arrays["log_odds"],
                created_by="understory 0.1.0",
            ).canonical()
    except InputError as error:
        raise InputError(error.problem, file=file, field=error.field, valid=error.valid) from error
    except (OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile, zlib.error) as error:
        raise InputError("no map of an old flight", file=file, valid="map.npz of a flight") from error
