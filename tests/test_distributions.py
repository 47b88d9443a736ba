"""Sampling distributions: limits, repeatability, errors; properties tests check the moments."""

import numpy as np
import pytest
from refusals import refused

from cvqmpt_lab.search.planner_interface import GaussianMixture, Uniform

LOWER, UPPER = np.array([-1.0, 2.0]), np.array([1.0, 5.0])
UNIFORM = Uniform(LOWER, UPPER)
MEANS = np.array([[0.0, 0.0], [10.0, -10.0]])
COVARIANCES = np.array([[[0.04, 0.03], [0.03, 0.09]], [[1.0, -0.5], [-0.5, 0.5]]])
WEIGHTS = np.array([0.3, 0.7])


@pytest.mark.parametrize(
    ("changes", "pattern"),
    [
        ({"covariances": COVARIANCES[:1]}, r"covariances \(1, 2, 2\)"),
        ({"weights": np.ones(3) / 3}, r"weights \(3,\)"),
        ({"weights": np.array([0.3, 0.3])}, "sum to 1, not 0.6"),
        ({"weights": np.array([1.5, -0.5])}, "non-negative"),
        ({"weights": np.array([np.nan, 1.0])}, "sum to 1, not nan"),
        ({"uniform_share": 0.1}, "0.1: give 0 to 1, with a uniform distribution"),
        ({"uniform_share": 1.2, "uniform": UNIFORM}, "1.2: give 0 to 1"),
        ({"uniform_share": np.nan, "uniform": UNIFORM}, "nan: give 0 to 1"),
        pytest.param({"means": MEANS * np.nan}, "means"),
        pytest.param({"covariances": -COVARIANCES}, "covariance"),
    ],
)
def test_unusable_mixtures_are_refused(changes, pattern):
    fields = {"means": MEANS, "covariances": COVARIANCES, "weights": WEIGHTS} | changes
    refused(pattern, GaussianMixture, **fields)
