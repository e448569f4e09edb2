"""OctoMap's files: `.bt` (free or occupied, two bits per child) and `.ot` (log-odds of every node).

Format: a text header, ended by `data`; then the nodes depth first, parents before children,
children in order of their number. `.bt`: two bytes per inner node, bits 2c and 2c + 1 of child c:
01 free leaf, 10 occupied leaf (bit 2c first: 1 0, 0 1), 11 inner. `.ot`: a little-endian float of
log-odds, for colour trees three bytes of colour, and a byte whose bit c says that child c is there.
Source: OctoMap 1.10, AbstractOcTree and OccupancyOcTreeBase (facts of the format).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from companion.core.errors import InputError
from companion.mapping.formats.octree import DEPTH, blocks_of, places, tree_of
from companion.mapping.formats.stored_map import COARSEST_M, FINEST_M, StoredMap
from companion.mapping.sensor_model import UNKNOWN, SensorModel, quantise

MOST_BLOCKS = 2_000_000  # a gigabyte of voxels
BINARY, FULL = b"# Octomap OcTree binary file", b"# Octomap OcTree file"
_COMMENT = b"# (feel free to add / change comments, but leave the first line as it is!)"
_NODE_BYTES = {"OcTree": 5, "OcTreeStamped": 5, "ColorOcTree": 8}  # of `.ot`, by id
_FREE, _OCCUPIED = -1, 0  # classes as log-odds
_CUT, _TOO_DEEP = -1, -2  # in place of a count


@dataclass(frozen=True, slots=True)
class _Header:
    binary: bool
    kind: str
    size: int
    resolution_m: float
    begin: int  # of the nodes


def write_bt(stored: StoredMap) -> bytes:
    """The map as `.bt`: what is occupied and what is free. Raises InputError beyond 2^15 voxels."""
    known = stored.log_odds != UNKNOWN
    classes = np.where(known, np.where(stored.log_odds >= 0, _OCCUPIED, _FREE), UNKNOWN).astype(np.int8)
    levels = tree_of(stored.block_xyz, classes)
    if not levels:
        return _head(BINARY, stored, 0)
    own = [np.where(level.child_mask != 0, 2, 0).astype(np.int64) for level in levels]
    begin, total = places(levels, own)
    out = np.zeros(total, np.uint8)
    for above, level in zip(begin, levels[1:], strict=False):
        leaf = np.where(level.value >= 0, 2, 1)
        bits = np.where(level.child_mask != 0, 3, leaf) << (2 * (level.child_number & 3))
        np.bitwise_or.at(out, above[level.parent] + (level.child_number >> 2), bits.astype(np.uint8))
    return _head(BINARY, stored, sum(len(level.value) for level in levels)) + out.tobytes()


def write_ot(stored: StoredMap) -> bytes:
    """The map as `.ot`: the log-odds, as float32. Raises InputError beyond 2^15 voxels."""
    levels = tree_of(stored.block_xyz, stored.log_odds)
    if not levels:
        return _head(FULL, stored, 0)
    begin, total = places(levels, [np.full(len(level.value), 5, np.int64) for level in levels])
    out = np.zeros(total, np.uint8)
    per_unit = quantise(stored.sensor).per_unit
    for place, level in zip(begin, levels, strict=True):
        nodes = np.empty((len(place), 5), np.uint8)
        nodes[:, :4] = (level.value / per_unit).astype("<f4").view(np.uint8).reshape(-1, 4)
        nodes[:, 4] = level.child_mask
        out[place[:, None] + np.arange(5)] = nodes
    return _head(FULL, stored, total // 5) + out.tobytes()


def _head(title: bytes, stored: StoredMap, size: int) -> bytes:
    facts = f"id OcTree\nsize {size}\nres {stored.resolution_m!r}\ndata\n".encode()
    return title + b"\n" + _COMMENT + b"\n#\n" + facts


def read_octomap(
    data: bytes, *, file: str = "", sensor: SensorModel | None = None, most_blocks: int = MOST_BLOCKS
) -> StoredMap:
    """The map of a `.bt` or `.ot`.

    `.bt` holds classes: its voxels get the clamps of `sensor`, the sensor model of the map (by
    default ours). Log-odds of `.ot` are rounded to the nearest step of `sensor` and clamped, but
    what is free there stays free. Colours and stamps are left out. Raises InputError that says
    what is wrong, also for a map of more than `most_blocks` blocks of 8^3 voxels.
    """
    head = _read_head(data, file)
    sensor = sensor or SensorModel()
    nodes = np.frombuffer(data, np.uint8, offset=head.begin)
    try:
        code, depth, value = _bt_leaves(nodes, head, sensor) if head.binary else _ot_leaves(nodes, head, sensor)
        xyz, log_odds = blocks_of(code, depth, value, most_blocks)
    except InputError as error:
        raise InputError(error.problem, file=file, field=error.field, valid=error.valid) from error
    return StoredMap(head.resolution_m, sensor, xyz, log_odds, created_by="OctoMap").canonical()


def _read_head(data: bytes, file: str) -> _Header:
    title = data[:256].split(b"\n", 1)[0].rstrip()
    if title not in (BINARY, FULL):
        raise InputError(
            "no OctoMap of today", file=file, valid=f"a first line {BINARY.decode()!r} or {FULL.decode()!r}"
        )
    end = data.find(b"\ndata", 0, 65536)
    begin = data.find(b"\n", end + 1) + 1 if end >= 0 else 0
    if begin == 0:
        raise InputError("the header has no end", file=file, valid="a line `data`")
    words = [line.split() for line in data[:end].decode("ascii", "replace").splitlines() if line[:1] not in ("#", "")]
    facts = {line[0]: line[1] for line in words if len(line) == 2}
    try:
        kind, size, resolution_m = facts["id"], int(facts["size"]), float(facts["res"])
    except (KeyError, ValueError) as error:
        raise InputError("the header is damaged", file=file, valid="lines `id`, `size` and `res`") from error
    if kind not in _NODE_BYTES:
        raise InputError(f"a tree of kind {kind[:40]!r}", file=file, field="id", valid=", ".join(_NODE_BYTES))
    if not FINEST_M <= resolution_m <= COARSEST_M or size < 0:
        raise InputError(f"size {size}, res {resolution_m}", file=file, valid=f"res {FINEST_M:g} to {COARSEST_M:g}")
    return _Header(title == BINARY, kind, size, resolution_m, begin)


def _bt_leaves(nodes: NDArray[np.uint8], head: _Header, sensor: SensorModel) -> Sequence[NDArray]:
    steps = quantise(sensor)
    most = 4 * len(nodes)
    code, depth, value = np.empty(most, np.int64), np.empty(most, np.uint8), np.empty(most, np.int8)
    count, counted, used = (0, 0, 0) if head.size == 0 else _walk_bt(nodes, code, depth, value)
    _check_walk(count, counted, len(nodes) - used, head)
    clamps = np.where(value[:count] == _OCCUPIED, steps.highest, steps.lowest).astype(np.int8)
    return code[:count], depth[:count], clamps


def _ot_leaves(nodes: NDArray[np.uint8], head: _Header, sensor: SensorModel) -> Sequence[NDArray]:
    steps, stride = quantise(sensor), _NODE_BYTES[head.kind]
    most = len(nodes) // stride
    code, depth, place = np.empty(most, np.int64), np.empty(most, np.uint8), np.empty(most, np.int64)
    count, counted, used = (0, 0, 0) if head.size == 0 else _walk_ot(nodes, stride, code, depth, place)
    _check_walk(count, counted, len(nodes) - used, head)
    bytes_ = nodes[place[:count, None] + np.arange(4)]
    exact = np.ascontiguousarray(bytes_).view("<f4").reshape(-1).astype(np.float64)
    if not np.all(np.isfinite(exact)):
        raise InputError("a node whose log-odds is no number", field="data")
    rounded = np.clip(np.rint(exact * steps.per_unit), steps.lowest, steps.highest)
    return code[:count], depth[:count], np.where(exact < 0, np.minimum(rounded, -1), rounded).astype(np.int8)


def _check_walk(count: int, counted: int, left: int, head: _Header) -> None:
    if count == _CUT:
        raise InputError("cut off: the tree is not complete", field="data")
    if count == _TOO_DEEP:
        raise InputError("damaged: a node below the voxels", field="data", valid=f"{DEPTH} levels")
    if left:
        raise InputError(f"{left} bytes follow the tree", field="data", valid="nothing")
    if counted != head.size:
        raise InputError(f"{counted} nodes, where the header says {head.size}", field="size", valid=str(counted))


@njit(cache=True, nogil=True)
def _walk_bt(nodes, codes, depths, values):  # type: ignore[no-untyped-def]
    """Leaves of `.bt`; returns their number (or what is wrong), that of all nodes, and the bytes read."""
    inner = np.zeros(DEPTH + 1, np.uint8)  # children still to visit, per depth of the path
    place, count, total, depth, code = 0, 0, 1, 0, 0
    while depth >= 0:
        if place + 2 > nodes.size:
            return _CUT, total, place
        word = np.int64(nodes[place]) | np.int64(nodes[place + 1]) << 8
        place += 2
        for child in range(8):
            kind = (word >> (2 * child)) & 3
            if kind == 3:
                if depth == DEPTH - 1:
                    return _TOO_DEEP, total, place
                inner[depth] |= np.uint8(1 << child)
            elif kind != 0:
                codes[count] = (code << 3 | child) << (3 * (DEPTH - 1 - depth))
                depths[count], values[count] = depth + 1, _OCCUPIED if kind == 2 else _FREE
                count += 1
            total += kind != 0
        depth, code = _next(inner, depth, code)
    return count, total, place


@njit(cache=True, nogil=True)
def _walk_ot(nodes, stride, codes, depths, places):  # type: ignore[no-untyped-def]
    """Leaves of `.ot` and where they stand; returns as `_walk_bt`."""
    inner = np.zeros(DEPTH + 1, np.uint8)
    place, count, total, depth, code = 0, 0, 0, 0, 0
    while depth >= 0:
        if place + stride > nodes.size:
            return _CUT, total, place
        inner[depth] = nodes[place + stride - 1]
        if inner[depth] == 0:
            codes[count], depths[count], places[count] = code << (3 * (DEPTH - depth)), depth, place
            count += 1
        elif depth == DEPTH:
            return _TOO_DEEP, total, place
        place += stride
        total += 1
        depth, code = _next(inner, depth, code)
    return count, total, place


@njit(cache=True, nogil=True)
def _next(inner, depth, code):  # type: ignore[no-untyped-def]
    """The next node on the walk; depth -1: the walk is over."""
    while depth >= 0 and inner[depth] == 0:
        depth, code = depth - 1, code >> 3
    if depth < 0:
        return depth, code
    child = 0
    while not inner[depth] >> child & 1:
        child += 1
    inner[depth] ^= np.uint8(1 << child)
    return depth + 1, code << 3 | child
