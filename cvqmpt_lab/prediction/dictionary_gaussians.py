"""The dictionary itself, in radians: a Gaussian for every code, and the codes of given configurations."""

import numpy as np

from cvqmpt_lab.errors import require_torch
from cvqmpt_lab.models.stored import StoredModel
from cvqmpt_lab.prediction.code_decoder import CodeDecoder
from cvqmpt_lab.prediction.code_encoder import CodeEncoder, code_vectors
from cvqmpt_lab.prediction.configurations import ModelConfigurations
from cvqmpt_lab.robot.robot import Robot


def dictionary_gaussians(model: StoredModel, robot: Robot) -> tuple[np.ndarray, np.ndarray]:
    """Means (codes, n) [rad] and covariances (codes, n, n) [rad^2] of every code, as the decoder gives them."""
    of = ModelConfigurations(model, robot)
    gaussians = CodeDecoder(model, np.float64).decode(code_vectors(model))
    return of.radians(gaussians.mean), gaussians.covariance * np.outer(of.range, of.range)


def codes_of(model: StoredModel, robot: Robot, configurations: np.ndarray) -> np.ndarray:
    """Code (b,) int64 of each configuration (b, n) [rad] of one path."""
    given = ModelConfigurations(model, robot).of(configurations)
    if model.config.dictionary.encoder == "mlp":
        return CodeEncoder.of(model)(given)
    require_torch("a dictionary whose encoder looks at whole trajectories")
    from cvqmpt_lab.prediction.published_network import trajectory_codes

    return trajectory_codes(model, given)


def drawn_nodes(means: np.ndarray, covariances: np.ndarray, robot: Robot, noise: np.ndarray) -> np.ndarray:
    """One configuration (codes, n) from each code's Gaussian, inside the limits; noise (codes, n): standard normal.

    Means crowd in the middle of where paths pass; draws cover it as training's waypoints do.
    """
    draws = means + np.einsum("kij,kj->ki", np.linalg.cholesky(covariances), noise)
    return np.clip(draws, robot.lower, robot.upper)
