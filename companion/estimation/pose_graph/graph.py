"""A pose graph as arrays: poses, and measured relative poses between pairs of them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from companion.core.errors import InputError
from companion.core.messages import Array


@dataclass(frozen=True, slots=True, eq=False)
class PoseGraph:
    """In the plane a pose is (x, y, yaw), in space (x, y, z, qw, qx, qy, qz); m, rad.

    `information` is the inverse covariance of a measurement in the tangent space of the pose that
    is measured: translation first, then rotation, (E, 3, 3) or (E, 6, 6).
    """

    ids: NDArray[np.int64]  # (N,), the names of the poses, each once
    poses: Array  # (N, 3) or (N, 7)
    ends: NDArray[np.int64]  # (E, 2), rows of `poses`: from, to
    measured: Array  # (E, 3) or (E, 7): pose `to` seen from pose `from`
    information: Array

    @property
    def spatial(self) -> bool:
        """Whether poses are in space, not in the plane."""
        return bool(self.poses.shape[1] == 7)

    @property
    def consecutive(self) -> NDArray[np.bool_]:
        """Which edges (E,) join a pose with the one after it: odometry; the others are closures."""
        a, b = self.ids[self.ends].T
        consecutive: NDArray[np.bool_] = np.abs(a - b) == 1
        return consecutive

    def with_poses(self, poses: Array) -> PoseGraph:
        """The same graph at other poses."""
        return replace(self, poses=poses)

    def with_closures(self, ends: NDArray[np.int64], measured: Array, information: Array) -> PoseGraph:
        """The same graph with more edges."""
        return replace(
            self,
            ends=np.vstack([self.ends, ends]),
            measured=np.vstack([self.measured, measured]),
            information=np.concatenate([self.information, information]),
        )


def check(graph: PoseGraph, *, file: str = "") -> PoseGraph:
    """The graph itself; InputError, naming `file`, when it cannot be optimised."""
    problem = _problem_of(graph)
    if problem is not None:
        raise InputError(problem, file=file, valid="a connected graph of poses and edges, each information positive")
    return graph


def _problem_of(graph: PoseGraph) -> str | None:
    if not len(graph.ids) or not len(graph.ends):
        return f"{len(graph.ids)} poses and {len(graph.ends)} edges are no graph"
    numbers = (graph.poses, graph.measured, graph.information)
    if not all(np.isfinite(part).all() for part in numbers):
        return "a number is not finite"
    lowest = np.linalg.eigvalsh(graph.information)[:, 0]
    if not (lowest > 0.0).all():
        return f"information of edge {graph.ids[graph.ends[np.argmin(lowest)]].tolist()} is not positive definite"
    loose = _not_reached(graph)
    return f"pose {loose[0]} and {len(loose) - 1} others hang on nothing" if len(loose) else None


def _not_reached(graph: PoseGraph) -> NDArray[np.int64]:
    """Ids of the poses that no chain of edges joins with the first."""
    count = len(graph.ids)
    joined = coo_array((np.ones(len(graph.ends)), graph.ends.T), shape=(count, count))
    _, label = connected_components(joined, directed=False)
    loose: NDArray[np.int64] = graph.ids[label != label[0]]
    return loose
