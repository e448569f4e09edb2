"""The last sweeps and the IMU between them, estimated jointly by Gauss-Newton; what is older is a prior and a map.

    window = JointWindow(Course(start), PointMap(lio.map), JointWindowConfig(), lio, rig)
    window.predict(imu)                       # (N, 7): dt, rate, specific force
    window.add_sweep(points_sensor, age_s)    # all sweeps of the window are registered anew, together
    window.filter.state.p, window.covariance

Each outer iteration linearises everything at the present estimates: IMU, prior, and the planes that all sweeps meet in
the map and in one another; planes are searched anew where a pose has moved. A node that leaves the window leaves a
prior on the next one and gravity (a Schur complement), and its sweep goes into the map: not before, so that the map
never holds what the window still measures, and with the pose that later sweeps have improved.

Source: the window is that of T. Shan et al., "LIO-SAM", IROS 2020, with sweeps registered inside as in H. Ye et al.,
"Tightly Coupled 3D Lidar Inertial Odometry and Mapping", ICRA 2019 (LIO-mapping), which fixes them to a pivot.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import msgspec
import numpy as np
from scipy.linalg import cho_factor, cho_solve

from companion.core.messages import Array, Array32
from companion.core.rig import Rig
from companion.estimation.blind_axes import BlindAxes
from companion.estimation.course import Course
from companion.estimation.downsample import Thinner
from companion.estimation.filter import Filter, is_small
from companion.estimation.imu_doubt import gap_covariance
from companion.estimation.map_error import MapError
from companion.estimation.normal import Normal
from companion.estimation.point_map import PointMap
from companion.estimation.state import ERROR
from companion.estimation.window.fresh_points import FreshPoints, new_to
from companion.estimation.window.joint_planes import Sweep, associate, linearise
from companion.estimation.window.nodes import Node, add_at, marginal, residual_between
from companion.estimation.window.preintegration import NODE_ERROR, preintegrate
from companion.estimation.window.prior import Prior, eliminate, pose_equations
from companion.estimation.window.twist import deskewed_by_twist, twist_between

if TYPE_CHECKING:  # of the front end, which has a rescue that has a window
    from companion.estimation.lio import LioConfig

_BRIDGED_S = 0.012  # a longer piece of the IMU holds no sample: `ImuBuffer` bridges gaps by steps of up to 0.02 s
Count = Annotated[int, msgspec.Meta(ge=1)]


class JointWindowConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """How much is estimated jointly."""

    sweeps: Annotated[int, msgspec.Meta(ge=1, le=40)] = 6  # the last ones
    iterations: Count = 10  # of Gauss-Newton per sweep, at most: mostly two


class JointWindow:
    """`filter` holds the newest state, predicted by the IMU beyond the newest node, and its covariance."""

    def __init__(
        self,
        course: Course,
        target: PointMap,
        config: JointWindowConfig,
        lio: LioConfig,
        rig: Rig,
        *,
        grows: bool = True,
    ) -> None:
        """It begins where `course` is, which it takes over; `grows`: sweeps that leave the window enter the map."""
        start = course.filter
        self.config, self._lio, self.map, self._grows = config, lio, target, grows
        self.course = course
        self._mount = (rig.lidar.R_body_sensor, rig.lidar.p_body)
        self._nodes = [Node(0, start.state.copy(), None, start.P[:6, :6].copy())]
        self._prior = Prior(start.state.copy(), np.asarray(np.linalg.inv(start.P), np.float64), np.zeros(ERROR))
        self._imu: list[Array] = []
        self._thinner, self._map_error = Thinner(), MapError()
        self._blind = BlindAxes(lio.blind)
        self._silent_s = 0.0  # of the IMU, since the newest node
        self._rate: Array | None = None  # rad/s, as a gyro would have it: of the last silent sweep
        self.normal: Normal | None = None  # what the newest sweep said of its own pose

    @property
    def filter(self) -> Filter:
        """State, covariance and time of now."""
        return self.course.filter

    @property
    def covariance(self) -> Array:
        """Of the error state in odom, (18, 18), with the map's own error."""
        return self.filter.P + self._map_error.covariance(self.filter.state)

    @property
    def newest_points(self) -> Array:
        """Of the newest sweep, (N, 3), body frame: those that are registered."""
        sweeps = self._sweeps()
        return sweeps[-1][1].points if sweeps else np.empty((0, 3))

    def predict(self, imu: Array, *, gap_s: float = 0.0) -> None:
        """Advance through IMU pieces (N, 7): dt, rate, specific force; `gap_s`: the longest time without a sample."""
        if not len(imu):
            return
        bridged, doubt = imu[:, 0] > _BRIDGED_S, self._lio.imu_doubt
        silent_s = min(gap_s, float(imu[bridged, 0].sum()))
        if silent_s > doubt.gap_s and self._rate is not None:
            imu = imu.copy()
            imu[bridged, 1:4] = self._rate
        self.course.predict(imu, self._lio.noise.densities)
        self._imu.append(imu)
        self._silent_s += silent_s
        if silent_s > doubt.gap_s:
            self.filter.P[:9, :9] += gap_covariance(silent_s, doubt)

    def add_sweep(self, points_sensor: Array32, age_s: Array32) -> Array32:
        """Take a sweep (N, 3) that ends now, each point `age_s` (N,) ago; returns it deskewed, body frame.

        While the IMU is silent it is registered twice, the second time deskewed by the motion that the first has found.
        """
        gate = self._lio.gate
        body = self.course.deskewed(points_sensor, age_s, self._mount, gate)
        node = self._register(body)
        if node.silent_s > self._lio.imu_doubt.gap_s and node.imu is not None and len(self._nodes) > 1:
            twist = twist_between(self._nodes[-2].state, node.state, node.imu.seconds)
            self._rate = twist[0] + node.state.gyro_bias
            body = deskewed_by_twist((points_sensor, age_s), twist, node.state, self._mount, gate)
            self._register(body)
        self._settle(node)
        return body

    def add_points(self, body: Array32) -> None:
        """Take a sweep (N, 3) that is deskewed into the body frame of now."""
        self._settle(self._register(body))

    def _register(self, body: Array32) -> Node:
        few = self._thinner.centroids(body, self._lio.thin_m, at_most=self._lio.points)
        node = self._new_node()
        node.sweep = Sweep(few, self._thinner.firsts(body, self._lio.map.spacing_m))
        self._associate(node)
        self._solve()
        return node

    def _settle(self, node: Node) -> None:
        """A window that does not grow the map is lost: it must not believe what it saw itself."""
        if self._grows and node.sweep is not None:
            self._find_fresh(node, node.sweep)
        self._blind.seen()
        self._let_go()

    def add_seen(self, seen: Normal) -> None:
        """Take what an image of now says of the pose; it is linearised once, where it says."""
        self._new_node().seen = seen
        self._solve()

    def _new_node(self) -> Node:
        """At the predicted state of now; no time since the newest: that one, which can hold a sweep and an image."""
        newest, f = self._nodes[-1], self.filter
        if not self._imu:
            return newest
        pieces, densities = np.concatenate(self._imu), self._lio.noise.densities
        # What a silent sweep is smeared by is wrong in its pose: it is as little known from there on.
        hidden_s, doubt = max(self._silent_s, newest.silent_s), self._lio.imu_doubt
        hidden = gap_covariance(hidden_s, doubt) if hidden_s > doubt.gap_s else None
        imu = preintegrate(pieces, newest.state.x[15:21], densities, hidden=hidden)
        node = Node(newest.number + 1, f.state.copy(), imu, f.P[:6, :6].copy(), silent_s=self._silent_s)
        self._imu, self._silent_s = [], 0.0
        self._nodes.append(node)
        return self._nodes[-1]

    def _sweeps(self) -> list[tuple[Node, Sweep]]:
        return [(n, n.sweep) for n in self._nodes if n.sweep is not None]

    def _associate(self, only: Node | None = None) -> FreshPoints:
        """Search planes for all sweeps, each on what is older, or for one; returns what the window has seen."""
        fresh = self._no_points(0)
        for node, sweep in self._sweeps():
            if only is None or node is only:
                associate(sweep, self.map, fresh, (node.state.R, node.state.p), self._lio.plane)
            fresh.insert(sweep.fresh, node.state.R, node.state.p, node.number)
        return fresh

    def _no_points(self, more: int) -> FreshPoints:
        c, capacity = self._lio.map, sum(len(s.fresh) for _, s in self._sweeps()) + more
        return FreshPoints(max(capacity, 1), voxel_m=c.voxel_m, spacing_m=c.spacing_m)

    def _find_fresh(self, node: Node, sweep: Sweep) -> None:
        """Of a sweep just registered, what neither the map nor the window has."""
        if not self._is_of_use(sweep):
            return
        R, p = node.state.R, node.state.p
        spaced = sweep.spaced.astype(np.float64)
        new = spaced[new_to(self.map, spaced, R, p)]
        seen = self._no_points(len(new))
        for other, of_other in self._sweeps()[:-1]:
            seen.insert(of_other.fresh, other.state.R, other.state.p, other.number)
        sweep.fresh = new[seen.insert(new, R, p, node.number)]

    def _is_of_use(self, sweep: Sweep) -> bool:
        """It met planes, or a map that is too small to know better."""
        return sweep.used >= self._lio.min_planes or self.map.voxels <= 4 * len(sweep.points)

    def _solve(self) -> None:
        """Gauss-Newton over all nodes and gravity; leaves the newest state and its covariance in `filter`."""
        before = self.course.pose()
        for _ in range(self.config.iterations):
            self._search_again()
            H, g = self._normal_equations()
            root = cho_factor(H, check_finite=False)
            step = cho_solve(root, g, check_finite=False)
            for k, node in enumerate(self._nodes):
                node.state.retract(np.concatenate([step[NODE_ERROR * k :][:NODE_ERROR], step[-3:]]))
            if all(is_small(step[k : k + 6]) for k in range(0, len(step) - 3, NODE_ERROR)):
                break
        self.filter.state.x[:] = self._nodes[-1].state.x
        self.filter.P = marginal(root, np.arange(len(g) - ERROR, len(g)), len(g))
        self.course.moved(before)

    def _search_again(self) -> None:
        beyond_m = self._lio.plane.search_again_m
        if any(s.is_stale(n.state.R, n.state.p, beyond_m) for n, s in self._sweeps()):
            self._associate()

    def _normal_equations(self) -> tuple[Array, Array]:
        """H and g by the errors of all nodes (15 each) and gravity (3), at the present estimates."""
        size = NODE_ERROR * len(self._nodes) + 3
        H, g = np.zeros((size, size)), np.zeros(size)
        gravity = np.arange(size - 3, size)
        add_at(H, g, np.r_[np.arange(NODE_ERROR), gravity], self._prior.at_state(self._nodes[0].state))
        for k, node in enumerate(self._nodes):
            if k > 0:
                at = np.r_[np.arange(NODE_ERROR * (k - 1), NODE_ERROR * (k + 1)), gravity]
                add_at(H, g, at, residual_between(self._nodes[k - 1], node).equations)
            if node.seen is not None:
                add_at(H, g, np.arange(NODE_ERROR * k, NODE_ERROR * k + 6), pose_equations(node.seen, node.state))
        self._add_sweeps(H, g)
        return H, g

    def _add_sweeps(self, H: Array, g: Array) -> None:
        R, p = np.array([n.state.R for n in self._nodes]), np.array([n.state.p for n in self._nodes])
        at = (NODE_ERROR * np.arange(len(self._nodes))[:, None] + np.arange(6)).ravel()
        for k, node in enumerate(self._nodes):
            if node.sweep is not None:
                add_at(H, g, at, self._said(node, node.sweep, k, (R, p)))

    def _said(self, node: Node, sweep: Sweep, k: int, poses: tuple[Array, Array]) -> tuple[Array, Array]:
        """What a sweep says of all poses; a blind one of its own only, as the filter takes it."""
        R, p = poses
        H, g = linearise(sweep, k, poses, self._nodes[0].number, self._lio.plane)
        if sweep.used < self._lio.min_planes:
            return np.zeros_like(H), np.zeros_like(g)
        block = slice(6 * k, 6 * k + 6)
        own = Normal(R[k], p[k], H[block, block].copy(), g[block].copy(), sweep.used, len(sweep.points))
        softened = self._blind.soften(own, node.P)
        if softened is not own:
            H[:], g[:] = 0.0, 0.0
            H[block, block], g[block] = softened.H, softened.g
        if node is self._nodes[-1]:
            self.normal = softened
        return H, g

    def _let_go(self) -> None:
        """Of the oldest, until the window has its size and begins with a sweep."""
        while len(self._nodes) > 1 and (self._nodes[0].sweep is None or len(self._sweeps()) > self.config.sweeps):
            oldest, after = self._nodes[0], self._nodes[1]
            pose = oldest.state.R[None].copy(), oldest.state.p[None].copy()
            said = [] if oldest.sweep is None else [self._said(oldest, oldest.sweep, 0, pose)]
            said += [] if oldest.seen is None else [pose_equations(oldest.seen, oldest.state)]
            imu = residual_between(oldest, after)
            self._prior = eliminate(self._prior, said, imu, (oldest.state, after.state))
            self._nodes = self._nodes[1:]
            if oldest.sweep is not None:
                self._into_map(oldest, oldest.sweep)

    def _into_map(self, node: Node, sweep: Sweep) -> None:
        """A sweep that has left the window, with the pose that it had at last.

        The map's error grows by the newest pose's covariance, not by the smaller one of this pose: what the sweeps of
        a window have in common is wrong in all of them.
        """
        R, p = node.state.R.copy(), node.state.p.copy()
        for _, other in self._sweeps():
            other.freeze(node.number, R, p)
        if not self._grows or not self._is_of_use(sweep):
            return
        share = self.map.insert(sweep.spaced, R, p) / max(len(sweep.spaced), 1)
        self._map_error.move(p)
        self._map_error.extend(node.state, self.filter.P, share * self._lio.map_error.share)
