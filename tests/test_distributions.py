"""Sampling distributions: shares, moments, limits, and what is refused."""

import numpy as np
import pytest

from cvqmpt_lab.distributions import GaussianMixture, Uniform
from cvqmpt_lab.errors import InvalidInputError

LOWER, UPPER = np.array([-1.0, 2.0]), np.array([1.0, 5.0])
MEANS = np.array([[0.0, 0.0], [10.0, -10.0]])
COVARIANCES = np.array([[[0.04, 0.03], [0.03, 0.09]], [[1.0, -0.5], [-0.5, 0.5]]])
WEIGHTS = np.array([0.3, 0.7])


def draw(distribution, count=50_000, seed=0):
    return distribution.sample(np.random.default_rng(seed), count)


def test_uniform_fills_the_limits():
    q = draw(Uniform(LOWER, UPPER))
    assert (q >= LOWER).all() and (q <= UPPER).all()
    np.testing.assert_allclose(q.mean(axis=0), 0.5 * (LOWER + UPPER), atol=0.02)
    np.testing.assert_allclose(q.std(axis=0), (UPPER - LOWER) / np.sqrt(12.0), atol=0.02)
    assert Uniform(LOWER, UPPER).name == "uniform"


def test_mixture_has_the_weights_means_and_covariances_asked_for():
    q = draw(GaussianMixture(MEANS, COVARIANCES, WEIGHTS))
    first = np.linalg.norm(q - MEANS[0], axis=1) < 5.0
    assert first.mean() == pytest.approx(0.3, abs=0.01)
    for part, mean, covariance in zip((q[first], q[~first]), MEANS, COVARIANCES, strict=True):
        np.testing.assert_allclose(part.mean(axis=0), mean, atol=0.02)
        np.testing.assert_allclose(np.cov(part.T), covariance, atol=0.02)


def test_uniform_share_is_mixed_in():
    tight = GaussianMixture(MEANS, COVARIANCES * 1e-6, WEIGHTS, Uniform(LOWER, UPPER), 0.25)
    q = draw(tight)
    anywhere = np.linalg.norm(q[:, None] - MEANS, axis=2).min(axis=1) > 0.1
    assert anywhere.mean() == pytest.approx(0.25, abs=0.01)
    assert (q[anywhere] >= LOWER).all() and (q[anywhere] <= UPPER).all()
    everywhere = draw(GaussianMixture(MEANS, COVARIANCES, WEIGHTS, Uniform(LOWER, UPPER), 1.0))
    assert (everywhere >= LOWER).all() and (everywhere <= UPPER).all()


@pytest.mark.parametrize(
    "distribution",
    [Uniform(LOWER, UPPER), GaussianMixture(MEANS, COVARIANCES, WEIGHTS, Uniform(LOWER, UPPER), 0.2)],
    ids=lambda d: d.name,
)
def test_draws_repeat_and_have_the_shape_asked_for(distribution):
    np.testing.assert_array_equal(draw(distribution, 20), draw(distribution, 20))
    assert not np.array_equal(draw(distribution, 20), draw(distribution, 20, seed=1))
    for count in (0, 1, 3):
        assert draw(distribution, count).shape == (count, 2)


@pytest.mark.parametrize(
    ("changes", "pattern"),
    [
        ({"covariances": COVARIANCES[:1]}, r"covariances \(1, 2, 2\)"),
        ({"weights": np.ones(3) / 3}, r"weights \(3,\)"),
        ({"weights": np.array([0.3, 0.3])}, "sum to 1, not 0.6"),
        ({"weights": np.array([1.5, -0.5])}, "non-negative"),
        ({"weights": np.array([np.nan, 1.0])}, "sum to 1, not nan"),
        ({"uniform_share": 0.1}, "0.1: give 0 to 1, with a uniform distribution"),
        ({"uniform_share": 1.2, "uniform": Uniform(LOWER, UPPER)}, "1.2: give 0 to 1"),
        ({"uniform_share": np.nan, "uniform": Uniform(LOWER, UPPER)}, "nan: give 0 to 1"),
        pytest.param({"means": MEANS * np.nan}, "means"),
        pytest.param({"covariances": -COVARIANCES}, "covariance"),
    ],
)
def test_unusable_mixtures_are_refused(changes, pattern):
    fields = {"means": MEANS, "covariances": COVARIANCES, "weights": WEIGHTS} | changes
    with pytest.raises(InvalidInputError, match=pattern):
        GaussianMixture(**fields)
