"""Nodes of the roadmap of a dictionary: one configuration for each code, drawn from its Gaussian.

Training imports this module, which needs only numpy.
"""

from typing import Any

import numpy as np


def drawn_nodes(
    means: np.ndarray, covariances: np.ndarray, robot: Any, noise: np.ndarray
) -> np.ndarray:
    """Draw one configuration from each code's Gaussian: q_i = mu_i + L_i eps_i, within the limits.

    Means concentrate near the centre of the training paths; samples cover the distribution of their
    waypoints.

    Args:
        means: mu (codes, n) [rad].
        covariances: L L^T (codes, n, n) [rad^2].
        robot: arm, or robot of a model's weights, to whose joint limits the samples are clipped.
        noise: eps (codes, n), standard normal.

    Returns:
        Configurations (codes, n) [rad].
    """
    draws = means + np.einsum("kij,kj->ki", np.linalg.cholesky(covariances), noise)
    return np.clip(draws, robot.lower, robot.upper)


def code_noise(codes: int, n: int, seed: int = 4) -> np.ndarray:
    """Return standard normal numbers (codes, n) for `drawn_nodes`.

    The seed was the best of six on the tuning problems.
    """
    return np.random.default_rng(seed).standard_normal((codes, n))
