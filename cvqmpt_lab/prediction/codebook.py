"""A dictionary's codes as Gaussians over configurations, in radians, and the codes of given configurations."""

from pathlib import Path

import numpy as np

from cvqmpt_lab.errors import require_torch
from cvqmpt_lab.models.stored import VQ_MPT, StoredModel, read_model
from cvqmpt_lab.prediction.code_decoder import CodeDecoder
from cvqmpt_lab.prediction.code_encoder import CodeEncoder, code_vectors
from cvqmpt_lab.prediction.configurations import ModelConfigurations, robot_signature
from cvqmpt_lab.prediction.weights import resolve_model
from cvqmpt_lab.robot.robot import Robot


class Codebook:
    """Decoder and code vectors of a model, for one robot."""

    def __init__(self, model: StoredModel, robot: Robot, dtype: type = np.float32) -> None:
        """Take over a model's dictionary; errors as `ModelConfigurations` and `CodeDecoder` raise them."""
        self.configurations = ModelConfigurations(model, robot)
        self.decoder, self.vectors = CodeDecoder(model, dtype), code_vectors(model)

    def gaussians(self, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Means (c, n) [rad] and covariances (c, n, n) [rad^2] of codes z (c, code_dim)."""
        gaussians, of = self.decoder.decode(z), self.configurations
        covariances = gaussians.covariance * np.outer(of.range, of.range)
        return of.radians(gaussians.mean.astype(np.float64)), covariances


def load_vq_mpt(robot: Robot, model: str | Path | None = None) -> StoredModel:
    """VQ-MPT for a robot; `model` and errors as in `resolve_model`, and those of `read_model`."""
    signature = robot_signature(robot)
    return read_model(resolve_model(model, VQ_MPT, signature), signature, VQ_MPT)


def dictionary_gaussians(model: StoredModel, robot: Robot) -> tuple[np.ndarray, np.ndarray]:
    """Means (codes, n) [rad] and covariances (codes, n, n) [rad^2] of every code, in double precision."""
    codebook = Codebook(model, robot, np.float64)
    return codebook.gaussians(codebook.vectors)


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
