import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from companion.core import messages as m
from companion.core import topics
from companion.core.fence import Fence
from companion.safety.assess import RANK, Health, SafetyConfig, assess
from companion.safety.node import SafetyNode

CONFIG = SafetyConfig()
FINE = Health(
    airborne=True,
    odometry_age_s=0.01,
    measured_age_s=0.05,
    lidar_age_s=0.1,
    map_age_s=0.2,
    position_std_m=0.02,
    quality=0.9,
    battery_fraction=0.8,
    fence_depth_m=math.inf,
    outside_s=0.0,
)


def verdict(**changed):
    return assess(dataclasses.replace(FINE, **changed), CONFIG)


def test_nothing_wrong_is_ok():
    assert verdict().action == "ok"


@pytest.mark.parametrize(
    ("field", "values"),
    [
        ("odometry_age_s", [(0.2, "ok"), (0.3, "hold"), (2.0, "land"), (math.inf, "land")]),
        ("measured_age_s", [(0.7, "ok"), (0.9, "hold"), (5.0, "land")]),
        ("lidar_age_s", [(0.3, "ok"), (0.5, "slow"), (1.1, "hold"), (9.0, "land")]),
        ("map_age_s", [(0.7, "ok"), (0.9, "slow"), (2.5, "hold"), (11.0, "land")]),
        ("position_std_m", [(0.4, "ok"), (0.6, "slow"), (1.5, "hold"), (4.0, "land"), (math.nan, "land")]),
        ("quality", [(0.3, "ok"), (0.2, "slow"), (math.nan, "slow")]),
        ("battery_fraction", [(0.1, "ok"), (0.05, "land"), (math.nan, "ok"), (-1.0, "ok")]),
        ("fence_depth_m", [(2.0, "ok"), (0.5, "slow"), (-0.1, "hold")]),
    ],
)
def test_each_input_escalates(field, values):
    for value, action in values:
        assert verdict(**{field: value}).action == action, (field, value)


def test_long_outside_the_fence_lands():
    assert verdict(fence_depth_m=-1.0, outside_s=6.0).action == "land"


def test_the_strongest_wins_and_gives_the_reason():
    both = verdict(lidar_age_s=0.5, map_age_s=2.5, battery_fraction=0.01)
    assert (both.action, both.reason) == ("land", "battery 1% is critical")


ages = st.floats(0, 20) | st.just(math.inf)


@given(ages, ages, ages, ages, st.floats(0, 9), st.floats(0, 1), st.floats(0, 1), st.integers(0, 3))
def test_an_older_input_never_gives_a_milder_verdict(a, b, c, d, std, quality, battery, which):
    health = dataclasses.replace(
        FINE, odometry_age_s=a, measured_age_s=b, lidar_age_s=c, map_age_s=d, position_std_m=std,
        quality=quality, battery_fraction=battery,
    )  # fmt: skip
    name = ("odometry_age_s", "measured_age_s", "lidar_age_s", "map_age_s")[which]
    older = dataclasses.replace(health, **{name: getattr(health, name) + 1.0})
    assert RANK[assess(older, CONFIG).action] >= RANK[assess(health, CONFIG).action]


@given(ages, ages, ages)
def test_on_the_ground_only_odometry_counts_and_nothing_lands(odometry, lidar, local_map):
    health = dataclasses.replace(FINE, airborne=False, odometry_age_s=odometry, lidar_age_s=lidar, map_age_s=local_map)
    assert assess(health, CONFIG).action == ("hold" if odometry > CONFIG.odometry_hold_s else "ok")


class Guarded:
    """Feeds a SafetyNode at 20 Hz; parts can be switched off."""

    def __init__(self, fence=None):
        self.node, self.now_ns = SafetyNode(SafetyConfig(), fence=fence), 0
        self.on = {"odometry", "lidar", "map"}
        self.armed, self.landed, self.p = True, False, np.zeros(3)
        self.said, self.whys = [], []

    def run(self, seconds):
        end_ns = self.now_ns + round(seconds * 1e9)
        while self.now_ns < end_ns:
            self.feed()
            for out in self.node.tick("watch", self.now_ns):
                (self.said if out.topic is topics.SAFETY else self.whys).append(out.message)
            self.now_ns += 50_000_000
        return self.said[-1]

    def feed(self):
        now, zero = self.now_ns, np.zeros(3)
        q = np.array([1.0, 0, 0, 0])
        sent = []
        if "odometry" in self.on:
            sent.append((topics.ODOMETRY, m.Odometry(
                stamp_ns=now, p_odom=self.p.copy(), q_odom_body=q, v_odom=zero, omega_body=zero,
                pose_variance=np.full(6, 1e-4), velocity_variance=np.full(3, 1e-4), measured_ns=now,
                quality=0.9, reset_counter=0,
            )))  # fmt: skip
        if "lidar" in self.on:
            sent.append((topics.LIO_STATE, m.LioState(
                stamp_ns=now, p_odom=zero, q_odom_body=q, v_odom=zero, gyro_bias_body=zero,
                accel_bias_body=zero, gravity_odom=zero, covariance=np.eye(18), source="lidar",
                inlier_fraction=0.9, weakest_direction=0.3,
            )))  # fmt: skip
        if "map" in self.on:
            sent.append(
                (
                    topics.MAP_STATUS,
                    m.MapStatus(stamp_ns=now, scans=1, blocks=1, cold_blocks=0, forgotten_blocks=0, memory_bytes=1),
                )
            )
        sent.append((topics.VEHICLE, m.VehicleStatus(
            stamp_ns=now, connected=True, armed=self.armed, mode="OFFBOARD", landed=self.landed, ready=True,
            battery_fraction=0.9, p_odom=zero, v_odom=zero, text="",
        )))  # fmt: skip
        for topic, message in sent:
            assert list(self.node.handle(topic, message)) == []


def test_a_lost_lidar_slows_then_holds_then_lands():
    flight = Guarded()
    assert flight.run(3.0).action == "ok"
    flight.on -= {"lidar"}
    flight.run(10.0)
    order = list(dict.fromkeys(s.action for s in flight.said))
    assert order == ["ok", "slow", "hold", "land"]
    assert [w.what for w in flight.whys] == ["slow", "hold", "land"]
    scales = {s.action: s.speed_scale for s in flight.said}
    assert scales == {"ok": 1.0, "slow": SafetyConfig().slow_scale, "hold": 0.0, "land": 0.0}


def test_before_the_takeoff_a_missing_map_and_lidar_alarm_nobody():
    flight = Guarded()
    flight.armed, flight.landed = False, True
    flight.on = {"odometry"}
    assert flight.run(20.0).action == "ok"
    flight.armed, flight.landed = True, False  # from the takeoff on their age counts
    assert flight.run(0.3).action == "ok"
    assert flight.run(1.5).action == "hold"


def test_no_odometry_yet_holds_on_the_ground():
    flight = Guarded()
    flight.armed, flight.landed, flight.on = False, True, set()
    status = flight.run(1.0)
    assert (status.action, status.reason) == ("hold", "odometry age never heard")


def test_it_calms_down_only_after_a_while_and_never_takes_a_landing_back():
    flight = Guarded()
    flight.run(1.0)
    flight.on -= {"map"}
    assert flight.run(1.2).action == "slow"
    flight.on |= {"map"}
    assert flight.run(0.4).action == "slow"
    assert flight.run(0.3).action == "ok"
    flight.on -= {"odometry"}
    assert flight.run(2.0).action == "land"
    flight.on |= {"odometry"}
    assert flight.run(30.0).action == "land"
    flight.landed, flight.armed = True, False
    assert flight.run(1.0).action == "ok"


def test_leaving_the_fence_slows_holds_lands():
    fence = Fence(inside=((-5.0, -5.0), (5.0, -5.0), (5.0, 5.0), (-5.0, 5.0)), alt=(-2.0, 8.0))
    flight = Guarded(fence)
    flight.p = np.array([100.0, 50.0, 1.0])  # home is where it armed, wherever that is in odom
    assert flight.run(2.0).action == "ok"
    flight.p = np.array([104.5, 50.0, 3.0])
    assert flight.run(0.2).action == "slow"
    flight.p = np.array([105.5, 50.0, 3.0])
    assert flight.run(4.0).action == "hold"
    assert flight.run(2.0).action == "land"


def test_a_node_that_is_down_holds_in_the_air_until_it_is_back():
    flight = Guarded()
    flight.run(1.0)
    down = m.NodeHealth(stamp_ns=flight.now_ns, node="PlanningNode", alive=False, reason="ended with code -9")
    list(flight.node.handle(topics.HEALTH, down))
    status = flight.run(0.05)
    assert (status.action, status.reason) == ("hold", "PlanningNode is down: ended with code -9")
    back = m.NodeHealth(stamp_ns=flight.now_ns, node="PlanningNode", alive=True, reason="")
    list(flight.node.handle(topics.HEALTH, back))
    assert flight.run(1.0).action == "ok"
    gone = m.NodeHealth(stamp_ns=flight.now_ns, node="GraphNode", alive=False, reason="killed")
    list(flight.node.handle(topics.HEALTH, gone))
    assert flight.run(1.0).action == "ok"  # nothing of the flight leans on the graph at once


def test_lost_holds_and_then_lands_whatever_else_is_fine():
    lost = dataclasses.replace(FINE, lost_because="position sigma 1.40 m", lost_s=0.1)
    assert assess(lost, CONFIG).action == "hold"
    assert "1.40 m" in assess(lost, CONFIG).reason
    assert assess(dataclasses.replace(lost, lost_s=CONFIG.lost_land_s + 0.1), CONFIG).action == "land"
