"""Angles, quaternions and small rotations: round trips and derivatives."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from triline.solver.geometry import rotation as rot

RNG = np.random.default_rng(7)
ANGLES = np.column_stack([RNG.uniform(-3, 3, 50), RNG.uniform(-1.5, 1.5, 50), RNG.uniform(-3.1, 3.1, 50)])


def test_photogrammetric_matrix_is_the_product_of_three_rotations():
    expected = Rotation.from_euler("XYZ", ANGLES).as_matrix()
    np.testing.assert_allclose(rot.matrix_from_angles(*ANGLES.T), expected, atol=1e-14)


def test_photogrammetric_angles_round_trip():
    np.testing.assert_allclose(rot.angles_from_matrix(rot.matrix_from_angles(*ANGLES.T)), ANGLES, atol=1e-12)


def test_navigation_matrix_is_heading_pitch_roll():
    roll, pitch, heading = ANGLES.T
    expected = Rotation.from_euler("ZYX", np.column_stack([heading, pitch, roll])).as_matrix()
    np.testing.assert_allclose(rot.matrix_from_navigation(roll, pitch, heading), expected, atol=1e-14)


def test_navigation_angles_round_trip_with_heading_positive():
    back = rot.navigation_from_matrix(rot.matrix_from_navigation(*ANGLES.T))
    expected = ANGLES.copy()
    expected[:, 2] %= 2 * np.pi
    np.testing.assert_allclose(back, expected, atol=1e-12)
    assert (back[:, 2] >= 0).all()


def test_angles_jacobian_against_central_differences():
    J = rot.angles_jacobian(ANGLES)
    step = 1e-6
    for axis in range(3):
        theta = np.zeros(3)
        theta[axis] = step
        small = rot.matrix_from_quaternion(rot.quaternion_from_vector(theta))
        plus = rot.angles_from_matrix(small @ rot.matrix_from_angles(*ANGLES.T))
        minus = rot.angles_from_matrix(small.T @ rot.matrix_from_angles(*ANGLES.T))
        difference = (plus - minus + np.pi) % (2 * np.pi) - np.pi
        np.testing.assert_allclose(J[:, :, axis], difference / (2 * step), rtol=1e-5, atol=1e-7)


def test_quaternions_agree_with_scipy_and_round_trip():
    vectors = RNG.normal(size=(40, 3))
    vectors[0] = 0.0
    vectors[1] = 1e-12
    q = rot.quaternion_from_vector(vectors)
    np.testing.assert_allclose(rot.matrix_from_quaternion(q), Rotation.from_rotvec(vectors).as_matrix(), atol=1e-14)
    np.testing.assert_allclose(rot.vector_from_quaternion(q), Rotation.from_rotvec(vectors).as_rotvec(), atol=1e-12)
    same = rot.quaternion_from_matrix(rot.matrix_from_quaternion(q))
    np.testing.assert_allclose(np.abs(np.sum(same * q, axis=1)), 1.0, atol=1e-14)


def test_quaternion_product_is_the_matrix_product():
    p, q = (rot.quaternion_from_vector(RNG.normal(size=(20, 3))) for _ in range(2))
    product = rot.matrix_from_quaternion(rot.quaternion_multiply(p, q))
    np.testing.assert_allclose(product, rot.matrix_from_quaternion(p) @ rot.matrix_from_quaternion(q), atol=1e-14)
    unit = rot.quaternion_multiply(p, rot.quaternion_conjugate(p))
    np.testing.assert_allclose(unit, np.tile([0, 0, 0, 1.0], (20, 1)), atol=1e-15)


@pytest.mark.parametrize("shape", [(), (0,), (1,), (5,), (2, 4), (2, 0)])
def test_quaternions_and_matrices_of_any_shape(shape):
    vectors = RNG.normal(size=(*shape, 3))
    q = rot.quaternion_from_vector(vectors)
    R = rot.matrix_from_quaternion(3.0 * q)  # of any length
    assert q.shape == (*shape, 4) and R.shape == (*shape, 3, 3) and rot.quaternion_from_matrix(R).shape == q.shape
    np.testing.assert_allclose(np.linalg.norm(q, axis=-1), np.ones(shape), atol=1e-15)
    # a turn about an axis leaves the axis where it is
    np.testing.assert_allclose(np.einsum("...ij,...j->...i", R, vectors), vectors, atol=1e-14)


@pytest.mark.parametrize("shape", [(3,), (5, 3), (2, 4, 3)])
def test_skew_is_the_cross_product(shape):
    a, b = RNG.normal(size=shape), RNG.normal(size=shape)
    np.testing.assert_array_equal(rot.cross(a, b), np.cross(a, b))
    np.testing.assert_array_equal(rot.cross(a.reshape(-1, 3)[0], b), np.cross(a.reshape(-1, 3)[0], b))
    np.testing.assert_allclose(np.einsum("...ij,...j->...i", rot.skew(a), b), np.cross(a, b), atol=1e-14)


@pytest.mark.parametrize("shape", [(), (7,), (2, 3)])
def test_quaternions_of_angles_are_those_of_their_matrices(shape):
    angles = np.random.default_rng(5).uniform(-np.pi, np.pi, (*shape, 3))
    expected = rot.quaternion_from_matrix(rot.matrix_from_angles(*np.moveaxis(angles, -1, 0)))
    q = rot.quaternion_from_angles(angles)
    assert q.shape == (*shape, 4) and (q[..., 3] >= 0).all()
    assert np.abs(q - expected).max() < 1e-14


def test_the_product_of_plain_numbers_is_that_of_arrays():
    p, q = rot.quaternion_from_vector(np.random.default_rng(6).normal(0, 1.0, (2, 3)))
    assert np.abs(np.array(rot.multiply_plain(p.tolist(), q.tolist())) - rot.quaternion_multiply(p, q)).max() < 1e-15
