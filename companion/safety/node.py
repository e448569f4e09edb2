"""The safety node: turns messages into ages, asks `assess`, and calms down slowly."""

from __future__ import annotations

import math

import numpy as np

from companion.core import topics
from companion.core.correction import Correction
from companion.core.fence import Fence
from companion.core.messages import (
    Array,
    LioState,
    MapStatus,
    NodeHealth,
    Odometry,
    SafetyStatus,
    SmoothedState,
    VehicleStatus,
    Why,
)
from companion.core.node import Node, Outputs, every, on
from companion.safety.assess import RANK, Health, SafetyConfig, Verdict, assess


class SafetyNode(Node):
    """Watches every input that the flight leans on; `fence` is the mission's, home frame."""

    publishes = (topics.SAFETY, topics.WHY)

    def __init__(self, config: SafetyConfig, *, fence: Fence | None) -> None:
        self._config, self._fence = config, fence
        self._odometry: Odometry | None = None
        self._vehicle: VehicleStatus | None = None
        self._smoothed: SmoothedState | None = None
        self._lidar_ns: int | None = None
        self._map_ns: int | None = None
        self._down: dict[str, str] = {}  # node -> why
        self._p_map_home: Array | None = None
        self._airborne_ns: int | None = None
        self._outside_ns: int | None = None
        self._lost_ns: int | None = None  # since when the odometry says so
        self._verdict = Verdict("ok", "")
        self._calm_ns: int | None = None  # since when the inputs ask for less

    @on(topics.ODOMETRY)
    def _take_odometry(self, message: Odometry) -> None:
        self._odometry = message
        lost = message.health == "lost"
        self._lost_ns = (message.stamp_ns if self._lost_ns is None else self._lost_ns) if lost else None

    @on(topics.VEHICLE)
    def _take_vehicle(self, message: VehicleStatus) -> None:
        self._vehicle = message

    @on(topics.SMOOTHED)
    def _take_smoothed(self, message: SmoothedState) -> None:
        self._smoothed = message

    @on(topics.LIO_STATE)
    def _take_lio(self, message: LioState) -> None:
        if message.source == "lidar":
            self._lidar_ns = message.stamp_ns

    @on(topics.MAP_STATUS)
    def _take_map(self, message: MapStatus) -> None:
        self._map_ns = message.stamp_ns

    @on(topics.HEALTH)
    def _take_health(self, message: NodeHealth) -> None:
        self._down.pop(message.node, None)
        if not message.alive:
            self._down[message.node] = message.reason

    @every(hz=20)
    def watch(self, now_ns: int) -> Outputs:
        """One verdict; said in WHY when it changes."""
        before = self._verdict
        self._verdict = self._calmed(assess(self._health(now_ns), self._config), now_ns)
        action, reason = self._verdict.action, self._verdict.reason
        if action != before.action:
            because = reason or f"over: {before.reason}"
            yield topics.WHY(Why(stamp_ns=now_ns, node="safety", what=action, because=because))
        scale = {"ok": 1.0, "slow": self._config.slow_scale}.get(action, 0.0)
        yield topics.SAFETY(SafetyStatus(stamp_ns=now_ns, action=action, speed_scale=scale, reason=reason))

    def _calmed(self, now: Verdict, now_ns: int) -> Verdict:
        """Worse at once, better only after `calm_s`; a landing in the air is never taken back."""
        held = self._verdict
        if RANK[now.action] >= RANK[held.action]:
            self._calm_ns = None
            return now
        if held.action == "land" and self._airborne_ns is not None:
            return held
        if self._calm_ns is None:
            self._calm_ns = now_ns
        return now if now_ns - self._calm_ns >= self._config.calm_s * 1e9 else held

    def _health(self, now_ns: int) -> Health:
        self._follow(now_ns)
        odometry, vehicle = self._odometry, self._vehicle
        depth_m = self._fence_depth_m()
        outside = self._airborne_ns is not None and depth_m < 0
        self._outside_ns = (self._outside_ns or now_ns) if outside else None
        return Health(
            airborne=self._airborne_ns is not None,
            odometry_age_s=_age_s(now_ns, odometry.stamp_ns if odometry else None),
            measured_age_s=_age_s(now_ns, odometry.measured_ns if odometry else None),
            lidar_age_s=self._age_in_air_s(now_ns, self._lidar_ns),
            map_age_s=self._age_in_air_s(now_ns, self._map_ns),
            position_std_m=float(np.sqrt(np.maximum(odometry.pose_variance[3:], 0).max())) if odometry else math.inf,
            quality=odometry.quality if odometry else 0.0,
            battery_fraction=vehicle.battery_fraction if vehicle else math.nan,
            fence_depth_m=depth_m,
            outside_s=_age_s(now_ns, self._outside_ns) if outside else 0.0,
            down=tuple(self._down.items()),
            lost_s=_age_s(now_ns, self._lost_ns) if self._lost_ns is not None else 0.0,
            lost_because=odometry.health_reason if odometry and odometry.health == "lost" else "",
        )

    def _follow(self, now_ns: int) -> None:
        """Airborne from the takeoff on; home is where it stood when it armed."""
        vehicle = self._vehicle
        if vehicle is None or not vehicle.armed:
            self._airborne_ns = self._p_map_home = None
            return
        if self._p_map_home is None and self._odometry is not None:
            self._p_map_home = self._p_map()
        if vehicle.landed:
            self._airborne_ns = None
        elif self._airborne_ns is None:
            self._airborne_ns = now_ns

    def _age_in_air_s(self, now_ns: int, stamp_ns: int | None) -> float:
        """Age, counted from the takeoff at most: a map may be as late as that."""
        if self._airborne_ns is None:
            return 0.0
        return _age_s(now_ns, max(self._airborne_ns, stamp_ns or 0))

    def _p_map(self) -> Array:
        assert self._odometry is not None
        return Correction.newest(self._smoothed).to_map(self._odometry.p_odom)

    def _fence_depth_m(self) -> float:
        if self._fence is None or self._p_map_home is None:
            return math.inf
        return self._fence.depth_m(self._p_map() - self._p_map_home)


def _age_s(now_ns: int, stamp_ns: int | None) -> float:
    return math.inf if stamp_ns is None else max(0, now_ns - stamp_ns) * 1e-9
