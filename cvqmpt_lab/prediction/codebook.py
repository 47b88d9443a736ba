"""A dictionary's codes as Gaussians over configurations, in radians."""

import numpy as np

from cvqmpt_lab.models.stored import StoredModel
from cvqmpt_lab.prediction.code_decoder import CodeDecoder
from cvqmpt_lab.prediction.code_encoder import code_vectors
from cvqmpt_lab.prediction.configurations import ModelConfigurations
from cvqmpt_lab.robot.robot import Robot


class Codebook:
    """Decoder and code vectors of a model, for one robot."""

    def __init__(self, model: StoredModel, robot: Robot) -> None:
        """Take over a model's dictionary; errors as `ModelConfigurations` and `CodeDecoder` raise them."""
        self.configurations = ModelConfigurations(model, robot)
        self.decoder, self.vectors = CodeDecoder(model), code_vectors(model)

    def gaussians(self, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Means (c, n) [rad] and covariances (c, n, n) [rad^2] of codes z (c, code_dim)."""
        gaussians, of = self.decoder.decode(z, None), self.configurations
        covariances = gaussians.covariance * np.outer(of.range, of.range)
        return of.radians(gaussians.mean.astype(np.float64)), covariances


def widened(covariances: np.ndarray, std: float) -> np.ndarray:
    """Covariances (c, n, n) without a direction narrower than std."""
    values, vectors = np.linalg.eigh(covariances)
    narrow = values[:, 0] < std * std
    if not narrow.any():
        return covariances
    values, vectors = np.maximum(values[narrow], std * std), vectors[narrow]
    result = covariances.copy()
    result[narrow] = (vectors * values[:, None, :]) @ vectors.swapaxes(1, 2)
    return result
