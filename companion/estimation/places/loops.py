"""Finds places that were seen before, and what that says about the poses in between.

Keyframes hang on a chain of odometry. Each few metres the newest submap is compared with the
earlier ones by its trunks, then by registration; what holds becomes a closure of the pose graph,
which doubts closures (DCS) but not the chain. The corrected poses are given so that the newest
keyframe stays where odometry has it: what flies on odometry must not feel a loop.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import Annotated

import msgspec
import numpy as np

from companion.core.geometry import quaternion_from_rotation, rotation_from_quaternion
from companion.core.messages import Array, Array32
from companion.estimation.downsample import Thinner
from companion.estimation.places.submap import CompareConfig, Submap, compare
from companion.estimation.pose_graph.graph import PoseGraph
from companion.estimation.pose_graph.optimise import OptimiseConfig, optimise

Positive = Annotated[float, msgspec.Meta(gt=0)]
Count = Annotated[int, msgspec.Meta(ge=1)]


class LoopConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Keyframes, submaps, and which pairs are compared."""

    compare: CompareConfig = CompareConfig()
    optimise: OptimiseConfig = OptimiseConfig(kernel="dcs")
    audit: OptimiseConfig = OptimiseConfig(kernel="gnc")  # what it refuses is let go of before anything is said
    keyframe_m: Positive = 2.0  # way between keyframes
    submap_m: Positive = 6.0  # way between submaps
    window_m: Positive = 16.0  # way whose scans make a submap
    radius_m: Positive = 18.0  # of a submap
    scan_m: Positive = 1.0  # way between the scans that are kept
    thin_m: Positive = 0.12  # of scans and submaps
    least_way_m: Positive = 30.0  # flown between two submaps that may close a loop
    gate_m: Positive = 6.0  # distance by odometry of two submaps that are compared at most ...
    gate_share: Annotated[float, msgspec.Meta(ge=0, le=1)] = 0.03  # ... plus this share of the way between
    most_compared: Count = 4  # earlier submaps per new one, nearest first, so that no scan waits long
    most_closures: Count = 2  # per submap
    rest_m: Annotated[float, msgspec.Meta(ge=0)] = 25.0
    """After a closure that moves nothing odometry is right: so far is flown before places are compared again."""
    settled_m: Positive = 0.1  # a closure that disagrees less with the chain moves nothing
    least_sigma_m: Positive = 2e-3  # per keyframe, if odometry says how it drifts; it may say too little
    least_sigma_rad: Positive = 2e-4
    odometry_sigma_m: Positive = 0.01  # per keyframe, if it does not say ...
    odometry_share: Positive = 0.01  # ... plus this share of the step
    odometry_sigma_rad: Positive = 2e-3
    closure_sigma_m: Positive = 0.03
    closure_sigma_rad: Positive = 4e-3
    doubt_sigmas: Positive = 5.0  # farther from the chain, by what odometry says of itself, no closure can be ...
    doubt_from_m: Annotated[float, msgspec.Meta(ge=0)] = 0.15  # ... beyond this


Drift = tuple[float, float]  # variance of position (m2) and of yaw (rad2) in odom; they grow


@dataclass(frozen=True, slots=True, eq=False)
class Closure:
    """Keyframe `later` as seen from keyframe `earlier`; both are numbers of keyframes."""

    earlier: int
    later: int
    R: Array  # (3, 3), of body axes
    p: Array  # (3,), m, in the earlier body
    trunks: int  # that agreed; 0: known by its panorama
    near: float  # share of points that fit


class LoopFinder:
    """Feed it scans in order; `closures` grows when a place is recognised.

    >>> finder = LoopFinder(LoopConfig())
    >>> if finder.add(stamp_ns, points_body, R_odom_body, p_odom):
    ...     corrected = finder.corrected()
    """

    def __init__(self, config: LoopConfig) -> None:
        self.config = config
        self.stamps_ns: list[int] = []
        self.closures: list[Closure] = []
        self._newest: list[Closure] = []
        self.refused = 0  # closures that the audit let go of
        self.R_map_odom: Array = np.eye(3)  # as corrected last
        self.p_map_odom: Array = np.zeros(3)
        self._R: list[Array] = []  # of keyframes, as odometry had them
        self._p: list[Array] = []
        self._poses: list[Array] = []  # (7,) as corrected last, continued by odometry
        self._way: list[float] = []
        self._drift: list[Drift | None] = []  # of the keyframes
        self._submaps: list[Submap] = []
        self._recent: deque[tuple[float, Array32]] = deque()  # (way, points in odom)
        self._last: Array | None = None
        self._flown_m = 0.0
        self._rested_m = -math.inf  # way at which a closure moved nothing
        self._thinner = Thinner()

    def add(
        self, stamp_ns: int, points_body: Array32, R_odom_body: Array, p_odom: Array, drift: Drift | None = None
    ) -> int:
        """Take in one scan (N, 3); returns the number of new closures. `drift`: what odometry says of its own."""
        config = self.config
        if self._last is not None:
            self._flown_m += float(np.linalg.norm(p_odom - self._last))
        self._last = p_odom
        if not self._recent or self._flown_m - self._recent[-1][0] >= config.scan_m:
            self._remember(points_body, R_odom_body, p_odom)
        if self._way and self._flown_m - self._way[-1] < config.keyframe_m:
            return 0
        self._keyframe(stamp_ns, R_odom_body, p_odom)
        self._drift.append(drift)
        since = self._flown_m - (self._way[self._submaps[-1].keyframe] if self._submaps else 0.0)
        return self._close() if since >= config.submap_m else 0

    @property
    def way_m(self) -> list[float]:
        """Flown by odometry up to each keyframe."""
        return list(self._way)

    @property
    def submaps(self) -> list[Submap]:
        """All of them, in order."""
        return list(self._submaps)

    @property
    def keyframe_p_odom(self) -> Array:
        """Positions (K, 3) of the keyframes as odometry had them."""
        return np.array(self._p).reshape(-1, 3)

    def keyframe_R_odom(self, number: int) -> Array:
        """Attitude (3, 3) of a keyframe as odometry had it."""
        return self._R[number]

    def poses(self) -> Array:
        """Poses (K, 7) of the keyframes as corrected last, continued by odometry."""
        return np.array(self._poses)

    def corrected(self) -> Array:
        """The most likely poses (K, 7) of the keyframes, x y z qw qx qy qz in odom, under which the newest stays."""
        in_map = self._optimised()
        R_new, p_new = rotation_from_quaternion(in_map[-1, 3:]), in_map[-1, :3]
        turn = self._R[-1] @ R_new.T
        self.R_map_odom, self.p_map_odom = turn.T, p_new - turn.T @ self._p[-1]
        rotations = [turn @ rotation_from_quaternion(q) for q in in_map[:, 3:]]
        places = (in_map[:, :3] - p_new) @ turn.T + self._p[-1]
        poses = np.array([_pose(R, p) for R, p in zip(rotations, places, strict=True)])
        self._poses = list(poses)
        return poses

    def audit(self) -> int:
        """Let go of closures that contradict the chain and most others (GNC); returns how many those are."""
        if not self.closures:
            return 0
        first = len(self._p) - 1  # edges of the chain come before closures
        wrong = {int(k) - first for k in optimise(self._graph(), self.config.audit).refused if k >= first}
        self.closures = [c for k, c in enumerate(self.closures) if k not in wrong]
        self.refused += len(wrong)
        return len(wrong)

    def _optimised(self) -> Array:
        """Poses (K, 7) in `map`, the frame in which the first keyframe stays where odometry had it."""
        graph = self._graph()
        first = graph.poses.copy()
        if len(first):
            R = self._R[0] @ rotation_from_quaternion(first[0, 3:]).T
            turned = [R @ rotation_from_quaternion(q) for q in first[:, 3:]]
            moved = (first[:, :3] - first[0, :3]) @ R.T + self._p[0]
            graph = graph.with_poses(np.array([_pose(A, p) for A, p in zip(turned, moved, strict=True)]))
        return optimise(graph, self.config.optimise).graph.poses

    def _remember(self, points_body: Array32, R: Array, p: Array) -> None:
        near = points_body[_square(points_body) < self.config.radius_m**2]
        points = self._thinner.firsts(np.ascontiguousarray(near), self.config.thin_m)
        self._recent.append((self._flown_m, (points @ R.T + p).astype(np.float32)))
        while self._flown_m - self._recent[0][0] > self.config.window_m:
            self._recent.popleft()

    def _keyframe(self, stamp_ns: int, R: Array, p: Array) -> None:
        if self._poses:
            last = self._poses[-1]
            turn = rotation_from_quaternion(last[3:]) @ self._R[-1].T
            pose = _pose(turn @ R, last[:3] + turn @ (p - self._p[-1]))
        else:
            pose = _pose(R, p)
        self._poses.append(pose)
        self._R.append(R.copy())
        self._p.append(p.copy())
        self._way.append(self._flown_m)
        self.stamps_ns.append(stamp_ns)

    def _close(self) -> int:
        """Make a submap of what was seen last and look for it among the earlier ones."""
        new = self._submap()
        found: list[Closure] = []
        resting = self._flown_m - self._rested_m < self.config.rest_m
        for old in [] if resting else self._candidates(new):
            closure = self._compare(old, new)
            if closure is not None:
                found.append(closure)
            if len(found) == self.config.most_closures:
                break
        self._submaps.append(new)
        self.closures.extend(found)
        self._newest = found
        if found and self.disagreement_m() < self.config.settled_m:
            self._rested_m = self._flown_m
        return len(found)

    def disagreement_m(self) -> float:
        """How far the newest closures are from what the chain of poses says, m."""
        return max((self._apart_m(closure) for closure in self._newest), default=0.0)

    def _apart_m(self, closure: Closure) -> float:
        a, b = self._poses[closure.earlier], self._poses[closure.later]
        chain = rotation_from_quaternion(a[3:]).T @ (b[:3] - a[:3])
        return float(np.linalg.norm(closure.p - chain))

    def _submap(self) -> Submap:
        config, number = self.config, len(self._p) - 1
        about = np.concatenate([points for _, points in self._recent]) - self._p[-1].astype(np.float32)
        about = about[_square(about) < config.radius_m**2]
        return Submap(number, self._thinner.firsts(np.ascontiguousarray(about), config.thin_m), config.compare)

    def _candidates(self, new: Submap) -> list[Submap]:
        """Earlier submaps that odometry allows to be the same place, nearest first."""
        here, way = self._poses[new.keyframe][:3], self._way[new.keyframe]
        near: list[tuple[float, Submap]] = []
        for old in self._submaps:
            between = way - self._way[old.keyframe]
            distance = float(np.linalg.norm(self._poses[old.keyframe][:3] - here))
            if between >= self.config.least_way_m and distance <= self._gate_m(between):
                near.append((distance, old))
        return [old for _, old in sorted(near, key=lambda pair: pair[0])[: self.config.most_compared]]

    def _gate_m(self, between_m: float) -> float:
        return self.config.gate_m + self.config.gate_share * between_m

    def _compare(self, old: Submap, new: Submap) -> Closure | None:
        a, b = self._poses[old.keyframe], self._poses[new.keyframe]
        between = self._way[new.keyframe] - self._way[old.keyframe]
        met = compare(old, new, b[:3] - a[:3], self._gate_m(between))
        if met is None:
            return None
        R_old, R_new = self._R[old.keyframe], self._R[new.keyframe]
        R, p = R_old.T @ met.R @ R_new, R_old.T @ met.p
        closure = Closure(old.keyframe, new.keyframe, R, p, met.trunks, met.near)
        if self._apart_m(closure) <= self._possible_m(closure):
            return closure
        self.refused += 1
        return None

    def _possible_m(self, closure: Closure) -> float:
        """How far a true closure may be from what the chain says, m; inf: odometry says nothing of itself."""
        first, last, c = self._drift[closure.earlier], self._drift[closure.later], self.config
        if first is None or last is None:
            return math.inf
        place, yaw = (max(b - a, 0.0) for a, b in zip(first, last, strict=True))
        variance = place + yaw * float(closure.p @ closure.p) + c.closure_sigma_m**2
        return max(c.doubt_sigmas * math.sqrt(variance), c.doubt_from_m)

    def _graph(self) -> PoseGraph:
        """The chain of odometry, and the closures."""
        config, count = self.config, len(self._p)
        steps = [_relative(self._R[k], self._p[k], self._R[k + 1], self._p[k + 1]) for k in range(count - 1)]
        ends = [(k, k + 1) for k in range(count - 1)] + [(c.earlier, c.later) for c in self.closures]
        measured = np.array(steps + [_pose(c.R, c.p) for c in self.closures])
        sigmas = [self._step_sigmas(k, float(np.linalg.norm(measured[k, :3]))) for k in range(count - 1)]
        sigmas += [(config.closure_sigma_m, config.closure_sigma_rad)] * len(self.closures)
        weight = np.repeat(np.array(sigmas).reshape(-1, 2) ** -2.0, 3, axis=1)
        information = weight[:, :, None] * np.eye(6)
        return PoseGraph(np.arange(count), np.array(self._poses), np.array(ends), measured, information)

    def _step_sigmas(self, k: int, way_m: float) -> tuple[float, float]:
        """Of the step from keyframe k to the next, m per axis and rad: how much surer odometry was before it."""
        first, last, c = self._drift[k], self._drift[k + 1], self.config
        if first is None or last is None:
            return c.odometry_sigma_m + c.odometry_share * way_m, c.odometry_sigma_rad
        place, yaw = (max(b - a, 0.0) for a, b in zip(first, last, strict=True))
        return math.sqrt(place / 3.0 + c.least_sigma_m**2), math.sqrt(yaw + c.least_sigma_rad**2)


def _square(points: Array32) -> Array32:
    """Squared norms (N,); several times quicker than a sum along rows."""
    return np.asarray(np.einsum("ij,ij->i", points, points))


def _pose(R: Array, p: Array) -> Array:
    return np.concatenate([p, quaternion_from_rotation(R)])


def _relative(R_a: Array, p_a: Array, R_b: Array, p_b: Array) -> Array:
    return _pose(R_a.T @ R_b, R_a.T @ (p_b - p_a))
