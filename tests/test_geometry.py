"""Rotations and angles agree with finite differences, with scipy and with themselves."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.transform import Rotation

from rovgraph.geometry import (
    cross,
    exp_rotation,
    log_rotation,
    matrix_from_quaternion,
    matrix_from_rpy,
    quaternion_from_matrix,
    right_jacobian,
    rotate,
    rpy_from_matrix,
    rpy_jacobian,
    skew,
    transpose,
    wrap_angle,
)

STEP = 1e-6
vectors = arrays(float, 3, elements=st.floats(-1.7, 1.7))  # shorter than pi


@given(vectors)
def test_log_undoes_exp(v):
    np.testing.assert_allclose(log_rotation(exp_rotation(v)), v, atol=1e-9)


@given(vectors)
def test_exp_is_scipys(v):
    np.testing.assert_allclose(exp_rotation(v), Rotation.from_rotvec(v).as_matrix(), atol=1e-12)


@pytest.mark.parametrize("size", [0.0, 1e-12, 1e-8, 1e-4, 1e-3, 0.99e-2, 1.01e-2, 3.0])
def test_exp_and_right_jacobian_hold_on_both_sides_of_the_series(size):
    direction = np.array([0.48, -0.6, 0.64])
    alone, beside = size * direction, np.array([[2.0, 0.0, 0.0], size * direction])
    np.testing.assert_allclose(exp_rotation(alone), Rotation.from_rotvec(alone).as_matrix(), atol=1e-14)
    # with a large rotation beside it in the batch it takes another branch
    np.testing.assert_allclose(exp_rotation(beside)[1], exp_rotation(alone), atol=1e-14)
    np.testing.assert_allclose(right_jacobian(beside)[1], right_jacobian(alone), atol=1e-14)


@pytest.mark.parametrize("size", [0.0, 1e-5, 0.3, 2.5])
def test_right_jacobian_is_the_finite_difference_of_exp(size):
    v = size * np.array([0.48, -0.6, 0.64])
    numeric = np.empty((3, 3))
    for k in range(3):
        d = STEP * np.eye(3)[k]
        numeric[:, k] = log_rotation(transpose(exp_rotation(v - d)) @ exp_rotation(v + d)) / (2 * STEP)
    np.testing.assert_allclose(right_jacobian(v), numeric, atol=1e-8)


@given(st.floats(-np.pi, np.pi), st.floats(-1.5, 1.5), st.floats(-np.pi, np.pi))
def test_rpy_round_trip_and_scipys_convention(roll, pitch, yaw):
    R = matrix_from_rpy([roll, pitch, yaw])
    np.testing.assert_allclose(R, Rotation.from_euler("ZYX", [yaw, pitch, roll]).as_matrix(), atol=1e-12)
    np.testing.assert_allclose(wrap_angle(rpy_from_matrix(R) - [roll, pitch, yaw]), 0.0, atol=1e-9)


def test_positive_roll_pitch_yaw_lower_starboard_raise_the_nose_turn_clockwise():
    forward, starboard = np.eye(3)[0], np.eye(3)[1]
    assert (matrix_from_rpy([0.1, 0, 0]) @ starboard)[2] > 0
    assert (matrix_from_rpy([0, 0.1, 0]) @ forward)[2] < 0
    assert (matrix_from_rpy([0, 0, 0.1]) @ forward)[1] > 0


def test_rpy_jacobian_is_the_finite_difference_of_a_turn_in_n():
    rpy = np.array([[0.3, -0.4, 2.0], [-1.0, 0.9, -3.0], [0.0, 0.0, 0.0]])
    R, numeric = matrix_from_rpy(rpy), np.empty((3, 3, 3))
    for k in range(3):
        d = STEP * np.eye(3)[k]
        ahead, behind = rpy_from_matrix(exp_rotation(d) @ R), rpy_from_matrix(exp_rotation(-d) @ R)
        numeric[..., k] = wrap_angle(ahead - behind) / (2 * STEP)
    np.testing.assert_allclose(rpy_jacobian(rpy), numeric, atol=1e-8)


@given(vectors, vectors)
def test_skew_and_cross_are_the_cross_product(a, b):
    np.testing.assert_allclose(skew(a) @ b, np.cross(a, b), atol=1e-14)
    np.testing.assert_allclose(cross(a, b), np.cross(a, b), atol=1e-14)


def test_leading_axes_broadcast():
    rng = np.random.default_rng(0)
    a, b = rng.standard_normal((4, 5, 3)), rng.standard_normal(3)
    np.testing.assert_allclose(cross(a, b), np.cross(a, b), atol=1e-14)
    np.testing.assert_allclose(rotate(skew(a), b), np.cross(a, b), atol=1e-14)
    R = exp_rotation(a)
    assert R.shape == (4, 5, 3, 3) and log_rotation(R).shape == (4, 5, 3)
    np.testing.assert_allclose(R[2, 3], exp_rotation(a[2, 3]), atol=1e-14)
    np.testing.assert_allclose(R @ transpose(R), np.broadcast_to(np.eye(3), R.shape), atol=1e-12)


@given(st.floats(-100.0, 100.0))
def test_wrapped_angles_lie_within_half_a_turn_and_point_the_same_way(angle):
    wrapped = wrap_angle(angle)
    assert -np.pi <= wrapped < np.pi
    np.testing.assert_allclose([np.sin(wrapped), np.cos(wrapped)], [np.sin(angle), np.cos(angle)], atol=1e-9)


@pytest.mark.parametrize("size", [1e-9, 1e-3, 1.0, 2.0, 3.1])
def test_quaternions_and_logarithms_are_those_of_scipy(size):
    expected = Rotation.from_rotvec(size * np.random.default_rng(3).standard_normal((500, 3)))
    R = expected.as_matrix()
    np.testing.assert_allclose(quaternion_from_matrix(R), Rotation.from_matrix(R).as_quat(), atol=1e-14)
    np.testing.assert_allclose(log_rotation(R), expected.as_rotvec(), rtol=1e-9, atol=1e-14)


def test_a_quaternion_becomes_the_matrix_that_scipy_makes_of_it_and_comes_back():
    q = np.random.default_rng(3).normal(size=(50, 4))
    q /= np.linalg.norm(q, axis=1, keepdims=True)
    R = matrix_from_quaternion(q * 1.005)  # rounded by whoever wrote it
    np.testing.assert_allclose(R, Rotation.from_quat(q).as_matrix(), atol=1e-12)
    np.testing.assert_allclose(np.abs(np.sum(quaternion_from_matrix(R) * q, axis=1)), 1.0, atol=1e-12)


@pytest.mark.parametrize("q", [(0.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.02), (np.nan, 0.0, 0.0, 1.0)])
def test_a_quaternion_that_is_not_of_unit_length_is_no_rotation(q):
    assert np.isnan(matrix_from_quaternion(q)).all()
