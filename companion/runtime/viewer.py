"""Standard ROS 2 topics beside our own, so that RViz, Foxglove and Rerun show a scene: frames, paths, clouds.

Frames as in ROS REP-105: `map` -> `odom` -> `base_link` -> the sensors.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from companion.core import topics
from companion.core.geometry import quaternion_from_rotation, rotation_from_quaternion
from companion.core.messages import (
    Array,
    Array32,
    Goal,
    Odometry,
    PlanStatus,
    RegisteredScan,
    SmoothedState,
    Trajectory,
    Why,
)
from companion.core.node import Topic
from companion.core.rig import Mount, Rig
from companion.runtime.wire.parts import header_of, quaternion_of, time_of

_FLOAT32 = 7  # sensor_msgs/PointField
_INFO, _WARN, _ERROR = 20, 30, 40  # rcl_interfaces/Log
_LEVELS = {  # of what an operator must see; every other decision is information
    ("SensorsNode", "sensor fault"): _WARN,
    ("safety", "slow"): _WARN,
    ("safety", "hold"): _WARN,
    ("safety", "land"): _ERROR,
}


@dataclass(frozen=True, slots=True)
class ViewTopic:
    """Where a view goes; `shared` topics stand outside the vehicle's namespace, as ROS wants them."""

    topic: str
    type: str
    shared: bool = False

    def full_name(self, vehicle: str) -> str:
        """On the bus."""
        return f"/{self.topic}" if self.shared else f"/{vehicle}/{self.topic}"


class View(NamedTuple):
    """One message of a standard type."""

    where: ViewTopic
    value: dict[str, Any]


TF = ViewTopic("tf", "tf2_msgs/msg/TFMessage", shared=True)
TF_STATIC = ViewTopic("tf_static", "tf2_msgs/msg/TFMessage", shared=True)
ODOM = ViewTopic("odom", "nav_msgs/msg/Odometry")
CLOUD = ViewTopic("cloud", "sensor_msgs/msg/PointCloud2")
PATH = ViewTopic("path", "nav_msgs/msg/Path")
PLAN = ViewTopic("plan", "nav_msgs/msg/Path")
GOAL = ViewTopic("goal", "geometry_msgs/msg/PoseStamped")
ROSOUT = ViewTopic("rosout", "rcl_interfaces/msg/Log", shared=True)


def views_of(topic: Topic[Any], message: Any) -> Iterator[View]:
    """What a viewer is told because of one of our messages."""
    if topic.name in _VIEWS:
        yield from _VIEWS[topic.name][0](message)


def announced(topic: Topic[Any]) -> tuple[ViewTopic, ...]:
    """Where the views of a topic will go, for who must declare it before the first."""
    return _VIEWS[topic.name][1] if topic.name in _VIEWS else ()


def sensor_frames(rig: Rig) -> View:
    """/tf_static: where the sensors sit on `base_link`."""
    mounts: dict[str, Mount] = {"lidar": rig.lidar, "camera": rig.camera, "range_finder": rig.range_finder}
    parts = [
        _transform(0, "base_link", child, mount.p_body, quaternion_from_rotation(mount.R_body_sensor))
        for child, mount in mounts.items()
    ]
    return View(TF_STATIC, {"transforms": parts})


def _odometry(o: Odometry) -> Iterator[View]:
    yield _frame(o.stamp_ns, "odom", "base_link", o.p_odom, o.q_odom_body)
    R_odom_body = rotation_from_quaternion(o.q_odom_body)
    covariance, rates = np.diag(np.concatenate([o.pose_variance[3:], o.pose_variance[:3]])), np.zeros((6, 6))
    rates[:3, :3] = R_odom_body.T @ np.diag(o.velocity_variance) @ R_odom_body
    value = {
        "header": header_of(o.stamp_ns, "odom"),
        "child_frame_id": "base_link",
        "pose": {"pose": _pose(o.p_odom, o.q_odom_body), "covariance": covariance.ravel()},
        "twist": {
            "twist": {
                "linear": _xyz(R_odom_body.T @ o.v_odom),
                "angular": _xyz(o.omega_body),
            },
            "covariance": rates.ravel(),
        },
    }
    yield View(ODOM, value)


def _smoothed(s: SmoothedState) -> Iterator[View]:
    yield _frame(s.stamp_ns, "map", "odom", s.p_map_odom, s.q_map_odom)


def _registered(scan: RegisteredScan) -> Iterator[View]:
    yield View(CLOUD, _cloud(scan.stamp_ns, "base_link", scan.points_body))


def _trajectory(t: Trajectory) -> Iterator[View]:
    yield _path(PATH, t.stamp_ns, t.p_odom)


def _plan(p: PlanStatus) -> Iterator[View]:
    yield _path(PLAN, p.stamp_ns, p.plan_p_odom)


def _goal(g: Goal) -> Iterator[View]:
    value = {"header": header_of(g.stamp_ns, "odom"), "pose": {"position": _xyz(g.p_odom)}}
    yield View(GOAL, value)


def _why(w: Why) -> Iterator[View]:
    text = f"{w.what}: {w.because}"
    level = _LEVELS.get((w.node, w.what), _INFO)
    value = {"stamp": time_of(w.stamp_ns), "level": level, "name": w.node, "msg": text}
    yield View(ROSOUT, value)


_VIEWS: dict[str, tuple[Callable[[Any], Iterator[View]], tuple[ViewTopic, ...]]] = {
    topics.ODOMETRY.name: (_odometry, (TF, ODOM)),
    topics.SMOOTHED.name: (_smoothed, (TF,)),
    topics.REGISTERED.name: (_registered, (CLOUD,)),
    topics.TRAJECTORY.name: (_trajectory, (PATH,)),
    topics.PLAN.name: (_plan, (PLAN,)),
    topics.GOAL.name: (_goal, (GOAL,)),
    topics.WHY.name: (_why, (ROSOUT,)),
}


def _frame(stamp_ns: int, parent: str, child: str, p: Array, q: Array) -> View:
    return View(TF, {"transforms": [_transform(stamp_ns, parent, child, p, q)]})


def _transform(stamp_ns: int, parent: str, child: str, p: Array, q: Array) -> dict[str, Any]:
    place = {"translation": _xyz(p), "rotation": quaternion_of(q)}
    return {"header": header_of(stamp_ns, parent), "child_frame_id": child, "transform": place}


def _path(where: ViewTopic, stamp_ns: int, points: Array) -> View:
    header = header_of(stamp_ns, "odom")
    poses = [{"header": header, "pose": {"position": _xyz(p)}} for p in points]
    return View(where, {"header": header, "poses": poses})


def _cloud(stamp_ns: int, frame: str, points: Array32) -> dict[str, Any]:
    names = enumerate(("x", "y", "z"))
    return {
        "header": header_of(stamp_ns, frame),
        "height": 1,
        "width": len(points),
        "fields": [{"name": n, "offset": 4 * k, "datatype": _FLOAT32, "count": 1} for k, n in names],
        "is_bigendian": False,
        "point_step": 12,
        "row_step": 12 * len(points),
        "data": np.ascontiguousarray(points, np.float32).reshape(-1).view(np.uint8),
        "is_dense": True,
    }


def _pose(p: Array, q: Array) -> dict[str, Any]:
    return {"position": _xyz(p), "orientation": quaternion_of(q)}


def _xyz(p: Array) -> dict[str, float]:
    x, y, z = p.tolist()
    return {"x": x, "y": y, "z": z}
