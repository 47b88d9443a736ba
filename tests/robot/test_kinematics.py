"""The kernels' own sine and cosine against numpy's."""

import numpy as np
import pytest
from numba import njit

from cvqmpt_lab.robot.kinematics import sine_and_cosine


@njit
def _of_all(angles, sines, cosines):
    for i in range(len(angles)):
        sines[i], cosines[i] = sine_and_cosine(angles[i])


def of(angles):
    """Sines and cosines (k,) of angles (k,)."""
    angles = np.asarray(angles, dtype=float)
    sines, cosines = np.empty_like(angles), np.empty_like(angles)
    _of_all(angles, sines, cosines)
    return sines, cosines


def assert_close(angles):
    for value, expected in zip(of(angles), (np.sin(angles), np.cos(angles)), strict=True):
        worst = np.argmax(np.abs(value - expected))
        assert np.abs(value - expected)[worst] <= 1e-15, angles[worst]


@pytest.mark.parametrize("largest", [1e-8, 1.0, np.pi, 100.0, 1e4, 1e5])
def test_random_angles(largest):
    assert_close(np.random.default_rng(0).uniform(-largest, largest, 200_000))


def test_where_the_quadrant_changes():
    """Multiples of pi / 4 and the doubles next to them, on both sides."""
    exact = np.arange(-12_000, 12_001) * (np.pi / 4.0)
    assert_close(np.concatenate([exact, np.nextafter(exact, np.inf), np.nextafter(exact, -np.inf)]))


def test_they_lie_on_the_unit_circle_and_are_odd_and_even():
    angles = np.random.default_rng(1).uniform(0.0, 1e4, 100_000)
    sines, cosines = of(angles)
    np.testing.assert_allclose(sines**2 + cosines**2, 1.0, rtol=0.0, atol=1e-15)
    np.testing.assert_array_equal(of(-angles), (-sines, cosines))


def test_small_angles_keep_their_digits():
    """Relative, not absolute: the sine of a tiny angle is the angle."""
    angles = 10.0 ** np.random.default_rng(2).uniform(-300.0, -0.2, 100_000)
    np.testing.assert_allclose(of(angles)[0], np.sin(angles), rtol=5e-16)


def test_zero():
    sines, cosines = of([0.0, -0.0])
    np.testing.assert_array_equal(sines, 0.0)
    np.testing.assert_array_equal(cosines, 1.0)


def test_what_is_not_finite_has_no_sine():
    assert np.isnan(of([np.nan, np.inf, -np.inf])).all()
