"""Loop node: registered scans in, corrected poses of the past out when a place is seen again."""

from __future__ import annotations

from typing import Annotated

import msgspec
import numpy as np

from companion.core.geometry import quaternion_from_rotation, rotation_from_quaternion
from companion.core.messages import LioState, MapFromOdom, PoseCorrections, RegisteredScan, Why
from companion.core.node import Node, Outputs, on
from companion.core.topics import CORRECTIONS, LIO_STATE, MAP_FROM_ODOM, REGISTERED, WHY
from companion.estimation.downsample import Thinner
from companion.estimation.places.constellation import constellation, match
from companion.estimation.places.loops import Drift, LoopConfig, LoopFinder
from companion.estimation.places.verify import align
from companion.estimation.places.views import panorama, sights


class LoopNodeConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Loops in flight."""

    enabled: bool = True
    loops: LoopConfig = LoopConfig()
    least_shift_m: Annotated[float, msgspec.Meta(ge=0)] = 0.15  # smaller corrections are not worth a new map


class LoopNode(Node):
    """Publishes only what moves the past and the map; odometry, and what flies on it, is never touched."""

    publishes = (CORRECTIONS, MAP_FROM_ODOM, WHY)

    def __init__(self, config: LoopNodeConfig) -> None:
        self.config = config
        self.finder = LoopFinder(config.loops)
        self._drift: Drift | None = None
        if config.enabled:
            self._compile()

    @on(LIO_STATE)
    def begin(self, state: LioState) -> Outputs:
        """A start of odometry is a new frame: what was seen before hangs on nothing."""
        turn = rotation_from_quaternion(state.q_odom_body)[2]
        theta, place = state.covariance[:3, :3], state.covariance[3:6, 3:6]
        self._drift = float(np.trace(place)), float(turn @ theta @ turn)
        if state.source == "start":
            self.finder = LoopFinder(self.config.loops)
            yield MAP_FROM_ODOM(self._map_from_odom(state.stamp_ns))

    @on(REGISTERED)
    def scan(self, scan: RegisteredScan) -> Outputs:
        """Remember it; say so when it closes a loop that moves anything."""
        if not self.config.enabled or not _usable(scan, self.finder):
            return
        R = rotation_from_quaternion(scan.q_odom_body)
        refused_before = self.finder.refused
        found = self.finder.add(scan.stamp_ns, scan.points_body, R, scan.p_odom, self._drift)
        if self.finder.refused > refused_before:
            yield WHY(
                _why(scan.stamp_ns, "a place seen again does not count", "it would be farther off than odometry can be")
            )
        if not found or not self._moves():
            return
        if refused := self.finder.audit():
            yield WHY(
                _why(scan.stamp_ns, f"{refused} closures are let go of", "the chain and the others contradict them")
            )
        before = self.finder.poses()
        poses = self.finder.corrected()
        shift_m = float(np.linalg.norm(poses[:, :3] - before[:, :3], axis=1).max())
        if shift_m < self.config.least_shift_m or not self.finder.closures:
            return
        closure = self.finder.closures[-1]
        what = f"place of keyframe {closure.earlier} seen again: the past moves by up to {shift_m:.2f} m"
        known_by = f"{closure.trunks} trunks agree" if closure.trunks else "what is around looks alike"
        yield WHY(_why(scan.stamp_ns, what, f"{known_by} and {closure.near:.0%} of the points fit"))
        yield CORRECTIONS(
            PoseCorrections(
                stamp_ns=scan.stamp_ns,
                stamps_ns=np.array(self.finder.stamps_ns, np.int64),
                p_odom=poses[:, :3].copy(),
                q_odom_body=poses[:, 3:].copy(),
            )
        )
        yield MAP_FROM_ODOM(self._map_from_odom(scan.stamp_ns))

    def _moves(self) -> bool:
        """Whether a new closure says more than the chain knows already."""
        return self.finder.disagreement_m() >= self.config.loops.settled_m

    def _map_from_odom(self, stamp_ns: int) -> MapFromOdom:
        finder = self.finder
        return MapFromOdom(
            stamp_ns=stamp_ns,
            p_map_odom=finder.p_map_odom.copy(),
            q_map_odom=quaternion_from_rotation(finder.R_map_odom),
            closures=len(finder.closures),
        )

    def _compile(self) -> None:
        """Compare a corner of a room and four trunks with themselves: no closure in flight waits for compilers."""
        grid = np.stack(np.meshgrid(np.arange(12.0), np.arange(12.0)), axis=-1).reshape(-1, 2) / 4.0
        walls = [np.insert(grid, axis, 0.0, axis=1) for axis in range(3)]
        corner = Thinner().firsts(np.concatenate(walls).astype(np.float32), self.config.loops.thin_m)
        compare = self.config.loops.compare
        align(corner, corner, (np.eye(3), np.zeros(3)), compare.verify)
        trunks = constellation(np.array([[0.0, 0.0], [3.0, 0.0], [0.0, 4.0], [5.0, 6.0]]), compare.constellation)
        match(trunks, trunks, compare.constellation)
        seen = panorama(corner, compare.view)
        sights(seen[None], np.zeros((1, 3)), seen, compare.view)


def _why(stamp_ns: int, what: str, because: str) -> Why:
    return Why(stamp_ns=stamp_ns, node="LoopNode", what=what, because=because)


def _usable(scan: RegisteredScan, finder: LoopFinder) -> bool:
    """Finite, a unit quaternion, newer than the last keyframe."""
    numbers = np.concatenate([scan.p_odom, scan.q_odom_body])
    newer = not finder.stamps_ns or scan.stamp_ns > finder.stamps_ns[-1]
    return newer and bool(np.isfinite(numbers).all()) and abs(float(scan.q_odom_body @ scan.q_odom_body) - 1.0) < 1e-3
