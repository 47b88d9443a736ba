"""Rotation logarithm and inverse left Jacobian, up to angle pi, against scipy and series."""

import math

import numpy as np
import pytest
from compiled_kernels import from_python
from scipy.spatial.transform import Rotation

from cvqmpt_lab.constraints.regions import log_map_factor, rotation_vector

log_map_factor, rotation_vector = map(from_python, (log_map_factor, rotation_vector))

BELOW_PI = np.pi - np.array([2e-4, 1e-6, 1e-9, 0.0])
ANGLES = [0.0, 1e-12, 1e-7, 1e-5, 9e-4, 1.1e-3, 0.1, 1.0, 3.0, *BELOW_PI]


def random_axes(count, seed=0):
    """Unit vectors (count, 3), the coordinate axes first."""
    axes = np.random.default_rng(seed).standard_normal((count, 3))
    axes[:3] = np.eye(3)
    return axes / np.linalg.norm(axes, axis=1)[:, None]


def log(R):
    return np.array(rotation_vector(*(tuple(column) for column in R.T)))


def skew(e):
    return np.array([[0.0, -e[2], e[1]], [e[2], 0.0, -e[0]], [-e[1], e[0], 0.0]])


def inverse_left_jacobian(e):
    factor, square = log_map_factor(tuple(e))
    assert square == pytest.approx(e @ e, rel=1e-12)
    return np.eye(3) - 0.5 * skew(e) + factor * skew(e) @ skew(e)


def left_jacobian(e):
    """Its power series, sum of [e]x^k / (k + 1)!, exact to double precision for |e| <= pi."""
    power, total = np.eye(3), np.eye(3)
    for k in range(1, 40):
        power = power @ skew(e)
        total = total + power / math.factorial(k + 1)
    return total


def test_log_of_random_rotations_is_scipy_s():
    for R in Rotation.random(2000, rng=np.random.default_rng(1)):
        np.testing.assert_allclose(log(R.as_matrix()), R.as_rotvec(), atol=1e-12)


@pytest.mark.parametrize("angle", ANGLES)
def test_log_at_special_angles(angle):
    """Angle in [0, pi] and exp(log R) = R; at pi either sign of the axis is right."""
    for axis in random_axes(50):
        R = Rotation.from_rotvec(angle * axis).as_matrix()
        e = log(R)
        assert np.linalg.norm(e) == pytest.approx(angle, abs=1e-13)
        np.testing.assert_allclose(Rotation.from_rotvec(e).as_matrix(), R, atol=2e-14)
        if np.pi - angle > 1e-7:
            np.testing.assert_allclose(e, angle * axis, atol=1e-12)


@pytest.mark.parametrize("angle", ANGLES)
def test_inverse_left_jacobian_inverts_the_series(angle):
    for axis in random_axes(20, seed=2):
        e = angle * axis
        np.testing.assert_allclose(
            inverse_left_jacobian(e) @ left_jacobian(e), np.eye(3), atol=1e-11
        )
