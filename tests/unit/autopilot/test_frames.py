"""Laws of the NED/FRD <-> ENU/FLU maps."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from companion.autopilot import frames
from companion.core.geometry import quaternion_from_yaw, rotation_from_quaternion, wrap_angle, yaw_of

_values = st.floats(-1e4, 1e4)
vectors = st.tuples(_values, _values, _values).map(np.array)
variances = st.tuples(*[st.floats(0, 1e3)] * 3).map(np.array)
_parts = st.floats(-1, 1)
quaternions = (
    st.tuples(_parts, _parts, _parts, _parts)
    .map(np.array)
    .filter(lambda q: np.linalg.norm(q) > 0.1)
    .map(lambda q: q / np.linalg.norm(q))
)
angles = st.floats(-math.pi, math.pi)

R_NED_ENU = np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]])
R_FRD_FLU = np.diag([1.0, -1, -1])


@given(vectors)
def test_vector_maps_undo_themselves(v):
    assert_allclose(frames.swap_world(frames.swap_world(v)), v)
    assert_allclose(frames.swap_body(frames.swap_body(v)), v)


@given(vectors)
def test_vector_maps_are_the_rotations_of_the_axes(v):
    assert_allclose(frames.swap_world(v), R_NED_ENU @ v)
    assert_allclose(frames.swap_body(v), R_FRD_FLU @ v)
    assert np.linalg.det(R_NED_ENU) == pytest.approx(1.0)


@given(quaternions)
def test_attitude_undoes_itself_and_stays_a_unit(q):
    assert_allclose(frames.swap_attitude(frames.swap_attitude(q)), q, atol=1e-15)
    assert np.linalg.norm(frames.swap_attitude(q)) == pytest.approx(1.0)


@given(quaternions)
def test_attitude_is_the_conjugation_by_both_axis_maps(q):
    expected = R_NED_ENU @ rotation_from_quaternion(q) @ R_FRD_FLU.T
    assert_allclose(rotation_from_quaternion(frames.swap_attitude(q)), expected, atol=1e-12)


@given(quaternions, vectors)
def test_rotating_then_swapping_is_swapping_then_rotating(q, v_flu):
    via_enu = frames.swap_world(rotation_from_quaternion(q) @ v_flu)
    via_ned = rotation_from_quaternion(frames.swap_attitude(q)) @ frames.swap_body(v_flu)
    assert_allclose(via_ned, via_enu, atol=1e-8)


@given(angles)
def test_yaw_agrees_with_the_attitude_of_a_level_body(yaw):
    ned = yaw_of(frames.swap_attitude(quaternion_from_yaw(yaw)))
    assert abs(wrap_angle(ned - frames.swap_yaw(yaw))) < 1e-9
    assert abs(wrap_angle(frames.swap_yaw(frames.swap_yaw(yaw)) - yaw)) < 1e-9


@given(angles, st.floats(-3, 3))
def test_yaw_rate_is_the_derivative_of_yaw(yaw, rate):
    dt = 1e-4
    turned = wrap_angle(frames.swap_yaw(yaw + rate * dt) - frames.swap_yaw(yaw))
    assert turned / dt == pytest.approx(frames.swap_yaw_rate(rate), abs=1e-6)


def test_headings_that_everyone_knows():
    assert frames.swap_yaw(0.0) == pytest.approx(math.pi / 2)  # east: 90 degrees
    assert frames.swap_yaw(math.pi / 2) == pytest.approx(0.0)  # north: 0
    assert_allclose(frames.swap_world(np.array([1.0, 2.0, 3.0])), [2.0, 1.0, -3.0])


@given(variances)
def test_variance_maps_are_those_of_the_covariance(variance):
    world = R_NED_ENU @ np.diag(variance) @ R_NED_ENU.T
    body = R_FRD_FLU @ np.diag(variance) @ R_FRD_FLU.T
    assert_allclose(frames.swap_world_variance(variance), np.diag(world))
    assert_allclose(frames.swap_body_variance(variance), np.diag(body))
