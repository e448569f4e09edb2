"""A filter and the way that it came: what a sweep needs to be brought into the frame of its end."""

from __future__ import annotations

import numpy as np

from companion.core.messages import Array, Array32
from companion.estimation.deskew import ScanGate, deskew_directions, deskew_points, move_nodes
from companion.estimation.filter import Filter
from companion.estimation.propagation import NODE

_NODE_HISTORY = 160  # 0.8 s at 200 Hz
Pose = tuple[Array, Array, Array]  # R, p, v


class Course:
    """Predicts a filter and keeps the nodes that it passed."""

    def __init__(self, filter_: Filter, nodes: Array | None = None) -> None:
        self.filter = filter_
        self._nodes = np.empty((0, NODE)) if nodes is None else nodes

    def copy(self) -> Course:
        """One that goes its own way."""
        f = self.filter
        return Course(Filter(f.state.copy(), f.P.copy(), f.t_s), self._nodes.copy())

    def predict(self, imu: Array, densities: Array) -> None:
        """Advance through IMU pieces (N, 7): dt, rate, specific force."""
        nodes = self.filter.predict(imu, densities)
        self._nodes = np.concatenate([self._nodes, nodes])[-_NODE_HISTORY:]

    def become(self, other: Course) -> None:
        """Take over its state, what it knows and its way; time stays."""
        self.filter.state.x[:], self.filter.P = other.filter.state.x, other.filter.P
        self._nodes = other._nodes

    def shift(self, t_s: float) -> None:
        """It is another time: the way lies as far back as before."""
        self._nodes[:, 0] += t_s - self.filter.t_s
        self.filter.t_s = t_s

    def pose(self) -> Pose:
        """A copy of (R, p, v)."""
        state = self.filter.state
        return state.R.copy(), state.p.copy(), state.v.copy()

    def moved(self, before: Pose) -> None:
        """A measurement has corrected the newest pose: the way moves with it."""
        move_nodes(self._nodes, before, self.pose())

    def deskewed(self, points_sensor: Array32, age_s: Array32, mount: tuple[Array, Array], gate: ScanGate) -> Array32:
        """Points (N, 3) of a sweep that ends now -> the body frame of now, (M, 3)."""
        R, p, _ = self.pose()
        return deskew_points(
            points_sensor,
            age_s,
            self._history(),
            pose_end=(R, p),
            t_end_s=self.filter.t_s,
            mount=mount,
            gate=gate,
        )

    def directions(self, dirs_sensor: Array32, age_s: Array32, R_body_sensor: Array) -> Array32:
        """Directions (N, 3) of a sweep that ends now -> the body frame of now."""
        return deskew_directions(
            dirs_sensor,
            age_s,
            self._history(),
            R_end=self.filter.state.R,
            t_end_s=self.filter.t_s,
            R_body_sensor=R_body_sensor,
        )

    def _history(self) -> Array:
        """The nodes passed, and the state of now, so that nothing is extrapolated from afar."""
        now = np.zeros((1, NODE))
        now[0, 0], now[0, 1:16] = self.filter.t_s, self.filter.state.x[:15]
        return np.concatenate([self._nodes, now])
