"""What the report keeps of a flight while it runs: a few columns, not the messages."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from companion.core import topics
from companion.core.correction import Correction
from companion.core.geometry import quaternion_multiply
from companion.core.messages import (
    Array,
    GroundTruth,
    MissionStatus,
    Odometry,
    PlanStatus,
    SafetyStatus,
    Why,
)
from companion.core.node import Topic


@dataclass(slots=True)
class Tracks:
    """Listens to a flight; `truth` is the simulator's word, everything else the stack's."""

    zero_ns: int = 0  # stamp that counts as 0 s
    truth: list[GroundTruth] = field(default_factory=list)
    odometry: list[Odometry] = field(default_factory=list)
    plans: list[PlanStatus] = field(default_factory=list)
    mission: list[MissionStatus] = field(default_factory=list)
    safety: list[SafetyStatus] = field(default_factory=list)
    why: list[Why] = field(default_factory=list)
    poses_map: list[MapPose] = field(default_factory=list)  # of each odometry, as odom then lay in map
    _odom: Correction = field(default_factory=lambda: Correction.newest(None))

    def heard(self, topic: Topic[Any], message: Any) -> None:
        """Keep what the report needs."""
        lists: dict[str, list[Any]] = {
            topics.TRUTH.name: self.truth,
            topics.ODOMETRY.name: self.odometry,
            topics.PLAN.name: self.plans,
            topics.MISSION.name: self.mission,
            topics.SAFETY.name: self.safety,
            topics.WHY.name: self.why,
        }
        if topic.name in lists:
            lists[topic.name].append(message)
        if topic is topics.SMOOTHED:
            self._odom = Correction.newest(message)
        elif topic is topics.ODOMETRY:
            self.poses_map.append(_in_map(message, self._odom))

    def true_track(self) -> Track:
        """Where the vehicle was, in the world."""
        return _track(self.truth, "p_world", "q_world_body", self.zero_ns)

    def estimated_track(self) -> Track:
        """Where the stack thought it was, in odom."""
        return _track(self.odometry, "p_odom", "q_odom_body", self.zero_ns)

    def map_track(self) -> Track:
        """The same in map, where a mission's goals lie: odometry through what was then known of odom in map."""
        return _track(self.poses_map, "p_map", "q_map_body", self.zero_ns)


@dataclass(frozen=True, slots=True)
class MapPose:
    """A pose of the body in map."""

    stamp_ns: int
    p_map: Array  # (3,)
    q_map_body: Array  # wxyz, (4,)


def _in_map(odometry: Odometry, odom: Correction) -> MapPose:
    q_map_body = quaternion_multiply(odom.q_map_odom, odometry.q_odom_body)
    return MapPose(odometry.stamp_ns, odom.to_map(odometry.p_odom), q_map_body)


@dataclass(frozen=True, slots=True)
class Track:
    """A trajectory in columns."""

    t_s: Array  # (N,)
    p: Array  # m, (N, 3)
    q: Array  # wxyz, (N, 4)

    def at(self, times: Array) -> Track:
        """Interpolated, positions linearly, attitudes on the sphere; before and after: the end's pose.

        A sample of the truth is 20 ms away from the next: its attitude as it is would tell 0.2 % of drift
        where there is a tenth of that.
        """
        p = np.column_stack([np.interp(times, self.t_s, self.p[:, k]) for k in range(3)])
        if len(self.t_s) < 2:
            return Track(times, p, np.repeat(self.q[:1], len(times), axis=0))
        between = Slerp(self.t_s, Rotation.from_quat(self.q, scalar_first=True))
        turned = between(np.clip(times, self.t_s[0], self.t_s[-1]))
        return Track(times, p, turned.as_quat(scalar_first=True))


def _track(messages: list[Any], position: str, attitude: str, zero_ns: int) -> Track:
    if not messages:
        return Track(np.empty(0), np.empty((0, 3)), np.empty((0, 4)))
    times = np.array([m.stamp_ns - zero_ns for m in messages]) * 1e-9
    p = np.array([getattr(m, position) for m in messages])
    return Track(times, p, np.array([getattr(m, attitude) for m in messages]))
