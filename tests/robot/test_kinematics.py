"""The kernels' own sine and cosine against numpy's."""

import numpy as np
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


def test_sine_and_cosine_are_numpys():
    """Also at multiples of pi / 4 and the doubles next to them, where the quadrant changes."""
    exact, rng = np.arange(-12_000, 12_001) * (np.pi / 4.0), np.random.default_rng(0)
    spread = [rng.uniform(-largest, largest, 100_000) for largest in (1e-8, 1.0, np.pi, 100.0, 1e4, 1e5)]
    for angles in (*spread, exact, np.nextafter(exact, np.inf), np.nextafter(exact, -np.inf), np.zeros(1)):
        for value, expected in zip(of(angles), (np.sin(angles), np.cos(angles)), strict=True):
            worst = np.argmax(np.abs(value - expected))
            assert np.abs(value - expected)[worst] <= 1e-15, angles[worst]


def test_small_angles_keep_their_digits():
    """Relative, not absolute: the sine of a tiny angle is the angle."""
    angles = 10.0 ** np.random.default_rng(2).uniform(-300.0, -0.2, 100_000)
    np.testing.assert_allclose(of(angles)[0], np.sin(angles), rtol=5e-16)


def test_what_is_not_finite_has_no_sine():
    assert np.isnan(of([np.nan, np.inf, -np.inf])).all()
