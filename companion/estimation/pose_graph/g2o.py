"""Pose graphs as g2o text: VERTEX_SE2, EDGE_SE2, VERTEX_SE3:QUAT, EDGE_SE3:QUAT.

Format: R. Kuemmerle et al., "g2o", ICRA 2011, and its file format page. A quaternion is written
x y z w, an information matrix by its upper triangle row by row, translation first.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from companion.core.errors import InputError
from companion.core.messages import Array
from companion.estimation.pose_graph.graph import PoseGraph

_LENGTHS = {"VERTEX_SE2": 1 + 3, "EDGE_SE2": 2 + 3 + 6, "VERTEX_SE3:QUAT": 1 + 7, "EDGE_SE3:QUAT": 2 + 7 + 21}
_PASSED_OVER = ("FIX", "#")  # what the optimiser decides itself: the first pose stays
_WXYZ = [0, 1, 2, 6, 3, 4, 5]  # of x y z qx qy qz qw
_XYZW = [0, 1, 2, 4, 5, 6, 3]


@dataclass(slots=True)
class _Rows:
    vertices: list[list[float]] = field(default_factory=list)
    edges: list[list[float]] = field(default_factory=list)
    kind: str = ""  # SE2 or SE3:QUAT


def read_g2o(text: str, *, file: str = "") -> PoseGraph:
    """The graph of a g2o text; InputError names the line of what is wrong."""
    rows = _Rows()
    for number, line in enumerate(text.splitlines(), start=1):
        words = line.split()
        if not words or words[0].startswith(_PASSED_OVER):
            continue
        values = _numbers(words, rows, file, number)
        (rows.vertices if words[0].startswith("VERTEX") else rows.edges).append(values)
    return _graph(rows, file)


def write_g2o(graph: PoseGraph) -> str:
    """The g2o text of a graph; `read_g2o` gives the same graph again, number by number."""
    kind, size = ("SE3:QUAT", 6) if graph.spatial else ("SE2", 3)
    order = _XYZW if graph.spatial else [0, 1, 2]
    upper = np.triu_indices(size)
    lines = [
        f"VERTEX_{kind} {name} {_words(pose)}"
        for name, pose in zip(graph.ids.tolist(), graph.poses[:, order], strict=True)
    ]
    for (a, b), seen, matrix in zip(
        graph.ids[graph.ends].tolist(), graph.measured[:, order], graph.information, strict=True
    ):
        lines.append(f"EDGE_{kind} {a} {b} {_words(seen)} {_words(matrix[upper])}")
    return "\n".join(lines) + "\n"


def _words(numbers: Array) -> str:
    return " ".join(repr(float(x)) for x in numbers)


def _numbers(words: list[str], rows: _Rows, file: str, number: int) -> list[float]:
    """The numbers of one line, counted and of the same kind as those before."""
    tag = words[0]
    if tag not in _LENGTHS:
        raise InputError(f"{tag!r} is not known", valid=", ".join(_LENGTHS), file=file, line=number)
    kind = tag.split("_")[1]
    rows.kind = rows.kind or kind
    if kind != rows.kind:
        raise InputError(f"{tag} beside {rows.kind}", valid="one kind per file", file=file, line=number)
    if len(words) != 1 + _LENGTHS[tag]:
        raise InputError(f"{len(words) - 1} numbers after {tag}", valid=str(_LENGTHS[tag]), file=file, line=number)
    try:
        return [float(word) for word in words[1:]]
    except ValueError as error:
        raise InputError(str(error), valid="numbers", file=file, line=number) from error


def _graph(rows: _Rows, file: str) -> PoseGraph:
    spatial = rows.kind == "SE3:QUAT"
    width, size = (7, 6) if spatial else (3, 3)
    vertices = np.array(rows.vertices).reshape(-1, 1 + width)
    edges = np.array(rows.edges).reshape(-1, 2 + width + size * (size + 1) // 2)
    ids = vertices[:, 0].astype(np.int64)
    if len(np.unique(ids)) != len(ids):
        raise InputError("a pose is there twice", field="VERTEX", file=file)
    order = np.argsort(ids, kind="stable")
    upper, information = np.triu_indices(size), np.zeros((len(edges), size, size))
    information[:, upper[0], upper[1]] = information[:, upper[1], upper[0]] = edges[:, 2 + width :]
    poses, measured = vertices[order, 1:], edges[:, 2 : 2 + width]
    if spatial:
        poses, measured = _unit(poses[:, _WXYZ], file), _unit(measured[:, _WXYZ], file)
    return PoseGraph(ids[order], poses, _ends(ids[order], edges[:, :2], file), measured, information)


def _unit(poses: Array, file: str) -> Array:
    """With quaternions of length one; files round them."""
    length = np.linalg.norm(poses[:, 3:], axis=1, keepdims=True)
    if not (length > 1e-6).all():
        raise InputError("a quaternion has no length", field="pose", file=file)
    # one that is a unit already stays bit by bit, so that writing and reading changes nothing
    scale = np.where(np.abs(length - 1.0) < 1e-12, 1.0, length)
    return np.hstack([poses[:, :3], poses[:, 3:] / scale])


def _ends(ids: NDArray[np.int64], named: Array, file: str) -> NDArray[np.int64]:
    wanted = named.astype(np.int64)
    known = np.isin(wanted, ids)
    if not known.all():
        raise InputError(f"pose {wanted[~known][0]} of an edge is not there", field="EDGE", file=file)
    return np.searchsorted(ids, wanted)
