"""Edges of a sweep beside its planes: the map of edges, and both registrations as one.

edges = EdgeMap(EdgesConfig(), rig.lidar)
seen_body = edges.find(points_body)
scan = EdgesAndPlanes(planes, LineRegistration(edges.map, seen_body, line))
edges.insert(seen_body, R, p)
"""

from __future__ import annotations

from typing import Annotated, Protocol

import msgspec
import numpy as np

from companion.core.messages import Array, Array32
from companion.core.rig import Mount
from companion.estimation.downsample import Thinner
from companion.estimation.edges import EdgeConfig, find_edges
from companion.estimation.lines import LineConfig, LineRegistration
from companion.estimation.normal import Normal
from companion.estimation.point_map import PointMap, PointMapConfig
from companion.estimation.registration import PlaneRegistration


class EdgesConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Of `edges_and_planes` only: which edges there are, and how they are registered."""

    find: EdgeConfig = EdgeConfig()
    map: PointMapConfig = PointMapConfig(voxel_m=1.0, points_per_voxel=24, averaged=20, max_voxels=100_000)
    line: LineConfig = LineConfig()
    thin_m: Annotated[float, msgspec.Meta(gt=0)] = 0.15  # one edge point per voxel of this edge
    points: Annotated[int, msgspec.Meta(ge=1)] = 600  # and at most so many


class Registration(Protocol):
    """A scan that can be linearised at one pose after another."""

    def linearise(self, R: Array, p: Array) -> Normal:
        """Normal equations at the pose (R_odom_body, p_odom)."""
        ...

    def fits(self, R: Array, p: Array, distance_m: float) -> tuple[int, int, int]:
        """How many points lie within a distance of what they meet in the map, how many meet it, how many there are."""
        ...


class EdgesAndPlanes:
    """Both of one scan: their normal equations added up."""

    def __init__(self, planes: PlaneRegistration, lines: LineRegistration) -> None:
        self._parts = planes, lines

    def linearise(self, R: Array, p: Array) -> Normal:
        """Normal equations at the pose (R_odom_body, p_odom)."""
        a, b = (part.linearise(R, p) for part in self._parts)
        return Normal(a.R, a.p, a.H + b.H, a.g + b.g, a.used + b.used, a.offered + b.offered)

    def fits(self, R: Array, p: Array, distance_m: float) -> tuple[int, int, int]:
        """How many points lie within a distance of their plane or line, how many have one, and how many there are."""
        a, b = (part.fits(R, p, distance_m) for part in self._parts)
        return a[0] + b[0], a[1] + b[1], a[2] + b[2]


class EdgeMap:
    """The edges seen so far, in odom."""

    def __init__(self, config: EdgesConfig, mount: Mount) -> None:
        self.map = PointMap(config.map)
        self._config, self._mount = config, mount
        self._thinner = Thinner()

    def find(self, points_body: Array32) -> Array:
        """The thinned edges (M, 3) of a deskewed sweep (N, 3), m, body frame."""
        c = self._config
        edges = find_edges(points_body, self._mount, c.find).astype(np.float32)
        return self._thinner.centroids(edges, c.thin_m, at_most=c.points)

    def insert(self, edges_body: Array, R: Array, p: Array) -> None:
        """Take the edges (M, 3) of a sweep to the map by the pose (R_odom_body, p_odom)."""
        self.map.insert(edges_body.astype(np.float32), R, p)
