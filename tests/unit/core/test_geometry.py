"""SO(3) laws, on random rotations."""

import math

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from companion.core.geometry import (
    exp_so3,
    log_so3,
    quaternion_conjugate,
    quaternion_from_rotation,
    quaternion_from_yaw,
    quaternion_multiply,
    rotate,
    rotation_from_quaternion,
    skew,
    wrap_angle,
    yaw_of,
)
from companion.core.rig import Rig

part = st.floats(-3, 3, allow_nan=False)
vectors = st.tuples(part, part, part).map(np.array)
angles = st.floats(-50, 50, allow_nan=False)


@given(vectors)
def test_exp_is_a_rotation_and_log_inverts_it(theta):
    R = exp_so3(theta)
    assert np.allclose(R @ R.T, np.eye(3), atol=1e-12)
    assert np.allclose(exp_so3(log_so3(R)), R, atol=1e-9)


@given(vectors, vectors)
def test_quaternion_product_is_the_matrix_product(a, b):
    qa, qb = (quaternion_from_rotation(exp_so3(v)) for v in (a, b))
    product = rotation_from_quaternion(quaternion_multiply(qa, qb))
    assert np.allclose(product, exp_so3(a) @ exp_so3(b), atol=1e-9)


@given(vectors, vectors)
def test_rotate_and_its_conjugate_cancel(theta, v):
    q = quaternion_from_rotation(exp_so3(theta))
    assert np.allclose(rotate(quaternion_conjugate(q), rotate(q, v)), v, atol=1e-9)


@given(vectors, vectors)
def test_skew_is_the_cross_product(a, b):
    assert np.allclose(skew(a) @ b, np.cross(a, b))


@given(angles)
def test_yaw_survives_the_quaternion(yaw):
    wrapped = wrap_angle(yaw)
    assert -math.pi < wrapped <= math.pi
    assert math.isclose(math.cos(yaw_of(quaternion_from_yaw(yaw)) - yaw), 1.0, abs_tol=1e-9)


def test_the_camera_looks_down_with_image_right_to_the_right():
    R = Rig().camera.R_body_sensor
    assert np.allclose(R @ [0, 0, 1], [0, 0, -1])  # optical axis down
    assert np.allclose(R @ [1, 0, 0], [0, -1, 0])  # image right is body right
    assert np.allclose(R @ [0, 1, 0], [-1, 0, 0])  # image down is body back
