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


@pytest.mark.parametrize("angle", ANGLES)
def test_log_and_inverse_left_jacobian_at_special_angles(angle):
    """exp(log R) = R, either sign of the axis is right at pi; the inverse inverts the series."""
    axes = np.random.default_rng(0).standard_normal((50, 3))
    axes[:3] = np.eye(3)
    for axis in axes / np.linalg.norm(axes, axis=1)[:, None]:
        R = Rotation.from_rotvec(angle * axis).as_matrix()
        e = log(R)
        assert np.linalg.norm(e) == pytest.approx(angle, abs=1e-13)
        np.testing.assert_allclose(Rotation.from_rotvec(e).as_matrix(), R, atol=2e-14)
        if np.pi - angle > 1e-7:
            np.testing.assert_allclose(e, angle * axis, atol=1e-12)
        product = inverse_left_jacobian(angle * axis) @ left_jacobian(angle * axis)
        np.testing.assert_allclose(product, np.eye(3), atol=1e-11)
