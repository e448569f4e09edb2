"""SET_POSITION_TARGET_LOCAL_NED by the rules of PX4."""

import math

import numpy as np
import pytest

from sim.autopilot.setpoint import Refused, complete, read_setpoint, stop

P, V, A = 0b111, 0b111 << 3, 0b111 << 6
FORCE, YAW, YAW_RATE = 1 << 9, 1 << 10, 1 << 11
NAN = math.nan


def read(mask, frame=1, yaw=0.0):
    return read_setpoint((0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0, 9.0, 0.5, 0.25, mask, 1, 1, frame), yaw)


@pytest.mark.parametrize("axis", range(9))
def test_each_axis_is_ignored_by_its_own_bit(axis):
    expected = [1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0, 9.0, 0.5, 0.25]
    expected[axis] = NAN
    np.testing.assert_array_equal(read(1 << axis), expected)


def test_yaw_and_yaw_rate_have_their_bits():
    assert np.isnan(read(YAW)[9])
    assert read(YAW)[10] == 0.25
    assert np.isnan(read(YAW_RATE)[10])
    assert read(YAW_RATE)[9] == 0.5


@pytest.mark.parametrize("frame", [0, 3, 7, 9, 12, 20, 21])
def test_other_frames_are_refused(frame):
    assert read(0, frame) == Refused(f"SET_POSITION_TARGET_LOCAL_NED coordinate frame {frame} unsupported")


@pytest.mark.parametrize("mask", [P | V | A, P | V | A | YAW, P | V | A | YAW_RATE])
def test_something_to_fly_is_needed(mask):
    assert read(mask) == Refused("SET_POSITION_TARGET_LOCAL_NED invalid")


@pytest.mark.parametrize("mask", [V | A, P | A, P | V, 0])
def test_any_one_of_the_three_is_enough(mask):
    assert not isinstance(read(mask), Refused)


def test_force_is_refused_only_with_an_acceleration():
    assert isinstance(read(FORCE), Refused)
    assert not isinstance(read(FORCE | A), Refused)


def test_the_body_frame_turns_velocity_and_acceleration_by_the_heading():
    sp = read(0, frame=8, yaw=math.pi / 2)
    assert np.isnan(sp[:3]).all()
    np.testing.assert_allclose(sp[3:6], [-5.0, 4.0, 6.0], atol=1e-12)
    np.testing.assert_allclose(sp[6:9], [-8.0, 7.0, 9.0], atol=1e-12)
    assert isinstance(read(V | A, frame=8), Refused)  # a position alone is nothing there


def test_infinities_are_not_flown():
    values = [0, math.inf, 2.0, 3.0, *[NAN] * 6, 0.5, 0.25, 0, 1, 1, 1]
    assert np.isnan(read_setpoint(tuple(values), 0.0)[0])


def test_completeness_needs_every_axis_and_horizontal_pairs():
    assert complete(read(V | A))
    assert complete(stop())
    assert not complete(read(V | A | 0b100))  # no demand down
    assert not complete(read(V | A | 0b001))  # north alone missing
    assert not complete(read(A | 0b001 | 1 << 4))  # north by velocity, east by position
    assert complete(read(A | 0b011 | 1 << 5))  # horizontal velocity, vertical position
