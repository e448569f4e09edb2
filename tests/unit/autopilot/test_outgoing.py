"""Setpoint masks and the ODOMETRY layout that PX4 and ArduPilot accept."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from companion.autopilot.outgoing import Target, odometry_message, setpoint_message
from companion.core.geometry import (
    exp_so3,
    quaternion_from_rotation,
    quaternion_from_yaw,
    rotation_from_quaternion,
)
from companion.core.messages import Odometry, Setpoint

NAN = math.nan
NONE = (NAN, NAN, NAN)
TARGET = Target(1, 1)


def setpoint(p=NONE, v=NONE, a=NONE, yaw=NAN, yaw_rate=NAN, stamp_ns=5_000_000_000) -> Setpoint:
    return Setpoint(
        stamp_ns=stamp_ns,
        p_odom=np.array(p),
        v_odom=np.array(v),
        a_odom=np.array(a),
        yaw=yaw,
        yaw_rate=yaw_rate,
    )


def send(flavour="px4", **demand):
    return setpoint_message(setpoint(**demand), TARGET, flavour)


def test_a_full_setpoint_in_ned():
    m = send(p=(1, 2, 3), v=(4, 5, 6), a=(7, 8, 9), yaw=0.0, yaw_rate=0.5)
    assert (m.x, m.y, m.z) == (2, 1, -3)
    assert (m.vx, m.vy, m.vz) == (5, 4, -6)
    assert (m.afx, m.afy, m.afz) == (8, 7, -9)
    assert m.yaw == pytest.approx(math.pi / 2) and m.yaw_rate == -0.5
    assert (m.type_mask, m.coordinate_frame) == (0, 1)
    assert (m.target_system, m.target_component, m.time_boot_ms) == (1, 1, 5000)


@pytest.mark.parametrize(
    ("demand", "mask"),
    [
        ({"p": (0, 0, 0), "yaw": 0.0}, 0b1001_1111_1000),  # 2552, as MAVSDK sent it to PX4
        ({"v": (0, 0, 0), "yaw_rate": 0.0}, 0b0101_1100_0111),  # 1479, as MAVSDK
        ({"v": (0, 0, 0), "yaw": 0.0}, 0b1001_1100_0111),  # 2503, as MAVSDK
        ({"a": (0, 0, 0)}, 0b1100_0011_1111),
        ({"p": (0, 0, 0), "v": (1, 0, 0), "a": (0, 0, 0), "yaw": 1.0}, 0b1000_0000_0000),
        ({"p": (0, 0, 0), "v": (1, 0, 0), "yaw": 1.0, "yaw_rate": 0.1}, 0b0001_1100_0000),
    ],
)
@pytest.mark.parametrize("flavour", ["px4", "ardupilot"])
def test_missing_triples_are_masked(demand, mask, flavour):
    assert send(flavour, **demand).type_mask == mask


def test_a_missing_axis_masks_itself_on_px4_and_its_triple_on_arducopter():
    demand = {"p": (NAN, NAN, 3.0), "v": (1.0, 2.0, NAN), "a": (1.0, 1.0, 1.0)}
    px4, copter = send("px4", **demand), send("ardupilot", **demand)
    assert px4.type_mask & 0b111_111_111 == 0b000_100_011  # height by position, x y by velocity
    assert (px4.z, px4.vx, px4.vy) == (-3.0, 2.0, 1.0)
    assert copter.type_mask & 0b111_111_111 == 0b000_111_111
    assert (copter.x, copter.z, copter.vx) == (0, 0, 0)


@pytest.mark.parametrize("flavour", ["px4", "ardupilot"])
def test_a_setpoint_without_any_axis_is_not_sent(flavour):
    assert send(flavour, yaw=1.0, yaw_rate=0.1) is None
    assert send(flavour, p=(math.inf, 1e300, NAN)) is None


@given(st.tuples(*[st.floats(allow_nan=True, allow_infinity=True)] * 11))
def test_no_number_breaks_the_message(numbers):
    message = send(p=numbers[:3], v=numbers[3:6], a=numbers[6:9], yaw=numbers[9], yaw_rate=numbers[10])
    if message is not None:
        assert all(math.isfinite(value) for value in message)


def odometry(**changes) -> Odometry:
    fields = {
        "stamp_ns": 1_234_567_890,
        "p_odom": np.array([1.0, 2.0, 3.0]),
        "q_odom_body": quaternion_from_yaw(0.0),
        "v_odom": np.array([0.5, 0.25, 0.125]),
        "omega_body": np.array([0.1, 0.2, 0.3]),
        "pose_variance": np.array([1.0, 2.0, 3.0, 4.0, 5.0, 6.0]),
        "velocity_variance": np.array([7.0, 8.0, 9.0]),
        "measured_ns": 0,
        "quality": 0.874,
        "reset_counter": 258,
    }
    return Odometry(**{**fields, **changes})


def as_sent(**changes):
    return odometry_message(odometry(**changes), stamp_ns=1_234_567_890, rate_variance=0.01)


def test_odometry_fields_that_both_autopilots_accept():
    m = as_sent()
    assert (m.frame_id, m.child_frame_id, m.estimator_type) == (20, 12, 3)
    assert (m.time_usec, m.quality, m.reset_counter) == (1_234_567, 87, 2)
    assert (m.x, m.y, m.z) == (2, 1, -3)
    assert (m.vx, m.vy, m.vz) == pytest.approx((0.5, -0.25, -0.125))  # facing east: body = odom
    assert (m.rollspeed, m.pitchspeed, m.yawspeed) == pytest.approx((0.1, -0.2, -0.3))


def test_covariances_are_diagonal_in_the_upper_triangle():
    m = as_sent()
    assert {i: v for i, v in enumerate(m.pose_covariance) if v} == {0: 5, 6: 4, 11: 6, 15: 1, 18: 2, 20: 3}
    assert {i: v for i, v in enumerate(m.velocity_covariance) if v} == {
        0: 7, 6: 8, 11: 9, 15: 0.01, 18: 0.01, 20: 0.01,
    }  # fmt: skip
    assert len(m.pose_covariance) == len(m.velocity_covariance) == 21


def test_the_triangle_indices_are_those_of_a_6x6_diagonal():
    rows, columns = np.triu_indices(6)
    assert [i for i in range(21) if rows[i] == columns[i]] == [0, 6, 11, 15, 18, 20]


@given(st.tuples(*[st.floats(-3, 3)] * 3).map(np.array))
def test_velocity_and_its_variance_turn_into_the_body(theta):
    R = exp_so3(theta)
    m = as_sent(q_odom_body=quaternion_from_rotation(R))
    assert_allclose([m.vx, -m.vy, -m.vz], R.T @ [0.5, 0.25, 0.125], atol=1e-12)
    variance = np.diag(R.T @ np.diag([7.0, 8.0, 9.0]) @ R)
    assert_allclose([m.velocity_covariance[i] for i in (0, 6, 11)], variance)
    p_dot_ned = rotation_from_quaternion(np.array(m.q)) @ [m.vx, m.vy, m.vz]
    assert_allclose(p_dot_ned, [0.25, 0.5, -0.125], atol=1e-9)  # pose and twist agree


@pytest.mark.parametrize("bad", [NAN, math.inf, 1e200])
@pytest.mark.parametrize("field", ["p_odom", "v_odom", "omega_body", "pose_variance", "velocity_variance"])
def test_odometry_that_is_not_finite_is_not_sent(bad, field):
    value = getattr(odometry(), field).copy()
    value[1] = bad
    assert as_sent(**{field: value}) is None
